import { download, facts, folded, h, oneIn, percent, table, when } from "./dom.js";
import { call, session } from "./service.js";
import { problemBox } from "./words.js";

const RIGHTS = {
  enroll: "enroll, list and describe people",
  verify: "verify people",
  erase: "erase people",
  export: "export and import templates",
  scores: "see distances",
  embeddings: "send embeddings and templates",
  metrics: "read the metrics",
  admin: "lift lockouts and read the audit log",
};

export function serviceView() {
  const { contract } = session;
  const save = () => download("contract.json", JSON.stringify(contract, null, 1));
  const root = h(
    "section",
    {},
    h("div", { class: "heading" }, h("h1", { tabindex: "-1" }, "Service"), health()),
    privacyCard(contract),
    h("div", { class: "columns" }, storedCard(contract), keyCard(session.own)),
    h(
      "section",
      { class: "card" },
      h(
        "div",
        { class: "heading" },
        h("h2", {}, "Levels"),
        h("button", { type: "button", class: "secondary", onclick: save }, "Download contract"),
      ),
      h("p", { class: "hint" }, "How often each level accepts a stranger, and rejects the right person, as counted when it was calibrated."),
      contract.calibrations.map(levelTable),
    ),
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
    : privacy.value > 0.7
      ? "nearly everybody could be recognised elsewhere"
      : privacy.value >= 0.25
        ? `about ${Math.round(10 * privacy.value)} in 10 people could be recognised elsewhere`
        : `about 1 person in ${Math.round(1 / privacy.value)} could be recognised elsewhere`;
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
function storedCard({ binding, contract_id: id, recorded, default_level: level, receipt_key: receipt }) {
  return h(
    "section",
    { class: "card" },
    h("h2", {}, "What is stored"),
    h("p", {}, "Of each person an id, dates, and one encrypted template: a set that holds the embedding among decoys. No photo, and no embedding as such. How well the set hides it is the verdict above."),
    folded(
      "Geometry and contract",
      facts([
        ["Template", `m = ${binding.m} of ${binding.axes} axes, ${binding.strategy}; embeddings have ${binding.n}`],
        ["Decoys", h("code", {}, binding.decoy_source_id)],
        ["Contract", h("code", {}, id)],
        ["Model pack", String(recorded.pack ?? "not recorded")],
        ["Default level", level],
        ["Receipt key", h("code", {}, receipt.public_key)],
      ]),
    ),
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
    ]),
    h(
      "ul",
      { class: "rights", "aria-label": "Rights" },
      Object.entries(RIGHTS).map(([right, meaning]) => {
        const has = own.rights.includes(right);
        return h("li", { class: has ? "has" : "lacks" }, h("strong", {}, right), ` ${has ? "may" : "may not"} ${meaning}`);
      }),
    ),
  );
}

function levelTable({ mode, probe_photos: photos, probe_m: m, levels }) {
  const many = photos === 1 ? "one photo" : `${photos} photos`;
  return table(
    mode === "p2s" ? `A probe of ${many}` : `A lifted probe of ${many}, m = ${m}`,
    ["Level", "Strangers accepted: target", "Strangers accepted: counted", "Right people rejected"],
    levels.map(({ name, target_fmr: target, fmr, fnmr }) => [
      name,
      target ? `${percent(target)} (${oneIn(target)})` : "none",
      counted(fmr),
      counted(fnmr),
    ]),
  );
}

function counted(rate) {
  if (!rate) return "unknown";
  const value = rate.trials ? rate.errors / rate.trials : null;
  return `${percent(value)} (${rate.errors.toLocaleString("en")} of ${rate.trials.toLocaleString("en")})`;
}
