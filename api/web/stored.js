import { bytes, command, facts, h, percent, table, when } from "./dom.js";
import { picture } from "./picture.js";
import { call, may, session, subjectPath } from "./service.js";
import { enroller, offNote, subjectField } from "./subject.js";
import { thiefCard } from "./verdict.js";
import { lacking, problemBox } from "./words.js";

export function storedView(id) {
  const why = may("enroll") ? null : lacking("enroll");
  const [subject, subjectPart] = subjectField(id);
  const shown = h("div", { class: "result" });
  const audit = h("div", {});

  function submit(event) {
    event.preventDefault();
    const target = `#/stored/${encodeURIComponent(subject.value)}`;
    if (location.hash === target) show(subject.value);
    else location.hash = target;
  }

  async function show(name) {
    shown.replaceChildren(h("p", { class: "hint", role: "status" }, "Reading…"));
    try {
      shown.replaceChildren(truth(await call("GET", `${subjectPath(name)}/stored`)));
    } catch (error) {
      shown.replaceChildren(problemBox(error));
      if (error.code === "not_enrolled") shown.append(enroller(name));
    }
  }

  call("GET", "/v1/contract/audit")
    .then((told) => audit.replaceChildren(audited(told)))
    .catch((error) => audit.replaceChildren(problemBox(error)));
  if (id && !why) show(id);
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, "What is stored"),
    h("p", { class: "lead" }, "No photo and no embedding, only an encrypted set of points that hides the face."),
    thiefCard(session.contract),
    offNote(why),
    h(
      "form",
      { class: "card inline", onsubmit: submit },
      h(
        "fieldset",
        { class: "plain", disabled: why !== null },
        subjectPart,
        h("button", { type: "submit", class: "secondary" }, "Show"),
      ),
    ),
    shown,
    audit,
  );
  return { root, stop() {} };
}

function truth(stored) {
  // What a client lifted itself may have been lifted otherwise.
  const by = stored.enrolled_by === "template" ? ", by the contract; lifted by a client" : "";
  return h(
    "div",
    {},
    h(
      "section",
      { class: "card" },
      h("h2", {}, `Stored about ${stored.subject_id}`),
      h(
        "div",
        { class: "columns" },
        facts([
          ["In the database", `${bytes(stored.sealed_bytes)}, encrypted (AES-256-GCM)`],
          ["Template inside", `${bytes(stored.wire_bytes)}, ${stored.dtype}`],
          ["Similarity of foot point to face", stored.foot_point_similarity.toFixed(3)],
          ["Dimension", `${stored.m} of ${stored.n}`],
          ["Lifting", stored.strategy ? stored.strategy + by : "under another contract"],
          ["Decoys", stored.decoys === null ? null : stored.decoys + by],
        ]),
        facts([
          ["Made from", stored.photos ? `${stored.photos} photos, not kept` : "a template sent by a client"],
          ["First enrolled", when(stored.created_at)],
          ["Enrolled", when(stored.updated_at)],
          ["Last accepted", when(stored.last_used_at)],
          ["Contract", h("code", {}, `${stored.contract_id.slice(0, 16)}…`)],
        ]),
      ),
      h("h3", {}, "Some of its bytes, as stored in the database"),
      h("code", { class: "hex" }, stored.sealed_excerpt.match(/.{1,8}/g).join(" ")),
      h("p", { class: "fine" }, "Ciphertext: noise without the master key."),
    ),
    h("section", { class: "card" }, h("h2", {}, "The set that hides the face"), picture(stored)),
  );
}

const ABOUT = {
  contract:
    "Made for this contract: its model, lifting, dimension and decoys. The id of a contract does not cover " +
    "thresholds: if it was calibrated again since, the shares that matched are those of the earlier ones.",
  scheme:
    "Made for the same model, lifting, dimension and kind of decoys, but not for this contract: its decoys " +
    "and thresholds are others. How much a template gives away depends on both.",
};

const ENDED = new Map([
  [true, "passed: no limit is exceeded"],
  [false, "failed: a limit is exceeded"],
  [null, "neither passed nor failed: no attack was judged"],
]);

function audited(told) {
  const title = h("h2", {}, "What an attacker gets, by audit");
  if (!told.audited || told.fits === "nothing") {
    return h(
      "section",
      { class: "card", "data-audit": told.audited ? "other" : "none" },
      title,
      h(
        "p",
        {},
        h("strong", {}, "This deployment has not been audited. "),
        told.audited
          ? "The report that is configured is about another contract. "
          : "So it is not known how much a stolen and decrypted template gives away here. ",
        "An operator can measure it:",
      ),
      h("p", {}, command(told.command)),
      h("p", { class: "fine" }, "and name the report.json in the setting audit_report_file."),
    );
  }
  const best = told.strongest;
  return h(
    "section",
    { class: "card", "data-audit": told.fits },
    title,
    h("p", {}, ABOUT[told.fits]),
    best
      ? h(
          "p",
          { class: "figure" },
          h("span", { class: "figure-number" }, amount(best, best.value)),
          h(
            "span",
            {},
            best.property === "irreversibility"
              ? ` of stolen and decrypted templates gave a match to the strongest attack on one template (${named(best)}).`
              : `: the strongest attack on one template (${named(best)}; by chance ${amount(best, best.chance)}).`,
          ),
        )
      : null,
    h(
      "p",
      {},
      "Verdict: ",
      h("strong", {}, ENDED.get(told.passed)),
      ".",
    ),
    told.headlines.length ? h("ul", {}, told.headlines.map((each) => h("li", {}, each))) : null,
    told.cells.length
      ? table(
          "Strongest attacks, and the operator's limits",
          ["Attack", "Breaks", "Leaked", "Attacker has", "Result", "By chance", "Against the limit", "Limit", "Verdict"],
          told.cells.map((each) => [
            named(each),
            each.property,
            each.leaked,
            each.knowledge,
            ranged(each, each.value, each.ci_low, each.ci_high),
            amount(each, each.chance),
            ranged(each, each.compared, each.compared_low, each.compared_high),
            each.most >= 1 ? "none" : amount(each, each.most),
            each.status ?? "",
          ]),
        )
      : null,
    told.cells.length
      ? h(
          "p",
          { class: "fine" },
          "In brackets: 95 % intervals. What stands against the limit is the result itself; for attributes ",
          "(confidentiality) its distance from chance, and for D_sys (unlinkability), a number from 0 to 1 ",
          "and not a share, its excess over chance.",
        )
      : null,
  );
}

// D_sys, the measure of linkability, is a number; all others are shares.
const amount = (cell, value) =>
  cell.property === "unlinkability" && value !== null ? String(Number(value.toPrecision(3))) : percent(value);

const ranged = (cell, value, low, high) =>
  amount(cell, value) +
  (low === null || high === null ? "" : ` [${amount(cell, low)}, ${amount(cell, high)}]`);

const named = (cell) => cell.attack + (cell.variant ? ` (${cell.variant})` : "");
