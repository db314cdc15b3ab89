import { download, facts, h, oneIn, percent, table, when } from "./dom.js";
import { call, session } from "./service.js";
import { problemBox } from "./words.js";

const RIGHTS = {
  enroll: "enroll, list and describe people",
  verify: "verify people",
  erase: "erase people",
  export: "export and import templates",
  scores: "see distances",
  embeddings: "send embeddings and templates",
  admin: "lift lockouts and read the audit log",
};

export function serviceView() {
  const { contract, own } = session;
  const health = h("div", { role: "status" }, h("p", { class: "hint" }, "Checking…"));
  ask(health);
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "Service"),
    h(
      "section",
      { class: "card" },
      h("h2", {}, "Verdict"),
      h(
        "p",
        {},
        "From the database alone a thief gets encrypted bytes, which open only with the master key. ",
        contract.verdict
          ? "What the strongest attack opened with the master key as well, and how accurate the service is:"
          : h("strong", {}, "Nobody has measured what opens with the master key as well: veilface calibrate does."),
      ),
      h(
        "div",
        { class: "columns three" },
        judged("Privacy: templates that a thief can open", contract.verdict?.privacy),
        judged("Accuracy: people turned away wrongly", contract.verdict?.accuracy),
        judged("Groups: strangers let in, in the worst group of people", contract.verdict?.groups),
      ),
    ),
    h(
      "div",
      { class: "columns" },
      h(
        "section",
        { class: "card" },
        h("h2", {}, "Health"),
        health,
        h(
          "p",
          {},
          h("button", { type: "button", class: "secondary", onclick: () => ask(health) }, "Check again"),
        ),
      ),
      h(
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
            return h(
              "li",
              { class: has ? "has" : "lacks" },
              h("span", { "aria-hidden": "true" }, has ? "✓ " : "– "),
              h("strong", {}, right),
              `: ${has ? "may" : "may not"} ${meaning}`,
            );
          }),
        ),
      ),
    ),
    h(
      "section",
      { class: "card" },
      h("h2", {}, "Contract"),
      h("p", { class: "hint" }, "What every template and threshold belongs to."),
      facts([
        ["Contract", h("code", {}, contract.contract_id)],
        ["Model pack", String(contract.recorded.pack ?? "not recorded")],
        ["Accepts photos", contract.photos ? "yes" : "no: there is no model pack"],
        ["Lifting", `${contract.binding.strategy}, m = ${contract.binding.m} of ${contract.binding.axes} axes, n = ${contract.binding.n}`],
        ["Decoys", h("code", {}, contract.binding.decoy_source_id)],
        ["Default level", contract.default_level],
        ["Receipt key", h("code", {}, contract.receipt_key.public_key)],
      ]),
      h(
        "p",
        {},
        h(
          "button",
          {
            type: "button",
            class: "secondary",
            onclick: () => download("contract.json", JSON.stringify(contract, null, 1)),
          },
          "Download contract",
        ),
      ),
      contract.calibrations.map((each) =>
        table(
          each.mode === "p2s"
            ? each.probe_photos === 1
              ? "Levels for one photo"
              : `Levels for ${each.probe_photos} photos of a probe`
            : `Levels for lifted probes, m = ${each.probe_m}`,
          ["Level", "Strangers accepted: target", "Measured (FMR)", "Right people rejected (FNMR)"],
          each.levels.map((level) => [
            level.name,
            level.target_fmr ? `${percent(level.target_fmr)} (${oneIn(level.target_fmr)})` : "none",
            counted(level.fmr),
            counted(level.fnmr),
          ]),
        ),
      ),
    ),
  );
  return { root, stop() {} };
}

// One judgement of the verdict: its figure, what was counted, and the limit.
function judged(title, judgement) {
  if (!judgement) return h("div", {}, h("h3", {}, title), h("p", {}, "Not measured."));
  const { rate, value, limit, status, basis, shortfall } = judgement;
  const group = basis.group ? `in ${basis.attribute} ${basis.group}, ` : "";
  const passes = status === "PASS";
  return h(
    "div",
    {},
    h("h3", {}, title),
    h(
      "p",
      { class: "figure" },
      h("span", { class: "figure-number" }, percent(value)),
      h("strong", { class: passes ? "ok" : "bad" }, passes ? "✓ PASS" : "✗ FAIL"),
    ),
    h(
      "p",
      { class: "hint" },
      `${group}${rate.errors} of ${rate.trials.toLocaleString("en")}; at most ${percent(limit)} passes`,
      shortfall ? `. Not enough to pass: ${shortfall}.` : ".",
    ),
  );
}

function counted(rate) {
  if (!rate) return "unknown";
  const value = rate.trials ? rate.errors / rate.trials : null;
  return `${percent(value)} (${rate.errors} of ${rate.trials.toLocaleString("en")})`;
}

async function ask(place) {
  const parts = [];
  for (const [what, path] of [
    ["Process", "/health/live"],
    ["Database and model", "/health/ready"],
  ]) {
    try {
      await call("GET", path);
      parts.push([what, h("span", { class: "ok" }, "✓ up")]);
    } catch (error) {
      if (error.code === "not_found") parts.push([what, "on the operations port only"]);
      else parts.push([what, problemBox(error)]);
    }
  }
  place.replaceChildren(facts(parts));
}
