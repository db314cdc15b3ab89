import { download, facts, h, percent, when } from "./dom.js";
import { call, session } from "./service.js";
import { problemBox } from "./words.js";

export function serviceView() {
  const { contract, own } = session;
  const root = h(
    "section",
    {},
    h("div", { class: "heading" }, h("h1", { tabindex: "-1" }, "Service"), health()),
    privacyCard(contract),
    h("div", { class: "columns" }, storedCard(contract), keyCard(own)),
  );
  return { root };
}

function health() {
  const strip = h("div", { class: "health", role: "status" }, "Checking…");
  call("GET", "/health/ready")
    .then(() => h("span", { class: "up" }, "Database and model are up"), problemBox)
    .then((answer) => strip.replaceChildren(answer));
  return strip;
}

// What a thief gets, in one line that says no more than was shown.
function privacyCard({ verdict }) {
  const { privacy, accuracy, groups } = verdict ?? {};
  const proven = privacy?.status === "PASS";
  const opens = !privacy?.rate.errors
    ? `none of ${privacy?.rate.trials.toLocaleString("en")} people could be recognised elsewhere`
    : `${percent(privacy.value)} of the people could be recognised elsewhere`;
  return h(
    "section",
    { class: `card privacy ${proven ? "proven" : "unproven"}` },
    h("h2", { class: "verdict-word" }, privacy ? (proven ? "✓ Privacy: proven" : "Privacy: not proven") : "Privacy: not measured"),
    h(
      "p",
      {},
      "A stolen database alone is encrypted, and opens only with the master key. ",
      privacy
        ? `If both are stolen, ${opens}.`
        : "Nobody has measured what opens if both are stolen: veilface calibrate does.",
      privacy?.shortfall ? ` This is not enough to prove it: ${privacy.shortfall}.` : "",
    ),
    h(
      "div",
      { class: "tiles" },
      tile("Recognised by a thief", privacy),
      tile("Right people rejected", accuracy),
      tile("Strangers accepted, in the worst group", groups),
    ),
  );
}

// One judgement of the verdict: its figure, what was counted, and the limit.
function tile(title, judgement) {
  if (!judgement) return h("div", {}, h("h3", {}, title), h("p", { class: "number" }, "–"), h("p", { class: "hint" }, "not measured"));
  const { rate, value, limit, status, basis } = judgement;
  const passes = status === "PASS";
  const mark = passes ? "✓ within" : status === "FAIL" ? "✕ above" : "not shown to be within";
  const group = basis.group ? `${basis.attribute} ${basis.group}, ` : "";
  return h(
    "div",
    {},
    h("h3", {}, title),
    h("p", { class: "number" }, percent(value)),
    h("p", { class: passes ? "ok" : "doubt" }, `${mark} the limit of ${percent(limit)}`),
    h("p", { class: "hint" }, `${group}${rate.errors} of ${rate.trials.toLocaleString("en")}`),
  );
}

// What the service keeps of a person, and by which contract.
function storedCard(contract) {
  const { binding, contract_id: id, recorded, default_level: level } = contract;
  const save = () => download("contract.json", JSON.stringify(contract, null, 1));
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "What is stored"),
    h("p", {}, "Of each person an id, dates, and one encrypted template: a set that holds the embedding among decoys. No photo, and no embedding as such. How well the set hides it is the verdict above."),
    facts([
      ["Template", `m = ${binding.m} of ${binding.axes} axes, ${binding.strategy}; embeddings have ${binding.n}`],
      ["Model pack", String(recorded.pack ?? "not recorded")],
      ["Default level", level],
      ["Contract", h("code", {}, id)],
    ]),
    h("p", { class: "row" }, h("button", { type: "button", class: "secondary", onclick: save }, "Download contract")),
  );
}

function keyCard(own) {
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "This key"),
    facts([
      ["Key", h("code", {}, `vf_${own.prefix}_…`)],
      ["Tenant", own.tenant],
      ["Expires", own.expires_at ? when(own.expires_at) : "never"],
      ["Rights", own.rights.join(", ")],
      ["Levels", own.levels.join(", ")],
    ]),
  );
}
