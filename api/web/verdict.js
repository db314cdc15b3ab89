import { h, percent } from "./dom.js";

// What the calibration found, in plain words; above everything that looks like mathematics.
export function thiefCard(contract) {
  const { verdict } = contract;
  const title = h("h2", {}, "What a thief would get");
  const without = h(
    "p",
    {},
    "From the database alone: encrypted bytes. They open only with the master key, which is kept elsewhere.",
  );
  if (!verdict) {
    return h(
      "section",
      { class: "card", "data-privacy": "unknown" },
      title,
      without,
      h(
        "p",
        {},
        "With the master key as well: ",
        h("strong", {}, "nobody has measured it here."),
        " An operator can, with ",
        h("code", {}, "veilface calibrate"),
        ".",
      ),
    );
  }
  const { privacy } = verdict;
  const faces = privacy.basis.attacker_faces;
  return h(
    "section",
    { class: "card", "data-privacy": privacy.status },
    title,
    without,
    h("p", {}, "With the master key as well, by the strongest attack on one template that the calibration tried:"),
    h(
      "p",
      { class: "figure" },
      h("span", { class: "figure-number" }, percent(privacy.value)),
      h(
        "span",
        {},
        ` of people could be matched with another photo of them (${privacy.rate.errors} of ` +
          `${privacy.rate.trials} who were tried` +
          (typeof faces === "number" ? `, by an attacker with ${faces.toLocaleString("en")} other faces` : "") +
          ").",
      ),
    ),
    h(
      "p",
      {},
      `At most ${percent(privacy.limit)} passes: `,
      mark(privacy.status),
      short(privacy),
    ),
  );
}

export const mark = (status) =>
  h("strong", { class: status === "PASS" ? "ok" : "bad" }, status === "PASS" ? "✓ PASS" : "✗ FAIL");

// One judgement of the verdict: its figure, what was counted, and the limit.
export function judged(title, judgement) {
  const parts = judgement ? counted(judgement) : [h("p", {}, "Not measured.")];
  return h("div", {}, h("h3", {}, title), parts);
}

const short = ({ shortfall }) => (shortfall ? `. Not enough to pass: ${shortfall}.` : ".");

function counted(judgement) {
  const { rate, value, limit, status, basis } = judgement;
  const group = basis.group ? `in ${basis.attribute} ${basis.group}, ` : "";
  return [
    h("p", { class: "figure" }, h("span", { class: "figure-number" }, percent(value)), mark(status)),
    h(
      "p",
      { class: "hint" },
      `${group}${rate.errors} of ${rate.trials.toLocaleString("en")}; at most ${percent(limit)} passes`,
      short(judgement),
    ),
  ];
}
