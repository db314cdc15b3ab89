// What a template is, drawn to scale from its true numbers, in two views: the set seen edge on, in the
// plane of the origin, the foot point and the face; and the set seen from the front, along the line
// from the origin to the foot point, cut in two of its m dimensions. All unit vectors of the set are
// equally far from the foot point: the face, and the decoys, which are candidates like it.

import { h, s } from "./dom.js";
import { session } from "./service.js";

const R = 135;
const X = 145;
const Y = 172;
const SHOWN = 16;

export function describe(stored) {
  const x = stored.foot_point_similarity;
  return (
    `The stored point nearest the origin resembles the face with similarity ${x.toFixed(3)}; ` +
    `every unit vector in the ${stored.m}-dimensional set at that angle ` +
    `(${angle(x).toFixed(1)} degrees) is equally a candidate.`
  );
}

const angle = (x) => (180 / Math.PI) * Math.acos(Math.min(1, x));
const dot = (kind, [cx, cy], r) => s("circle", { class: kind, cx, cy, r });
const label = (text, x, y, anchor = "start") => s("text", { x, y, "text-anchor": anchor }, text);

export function picture(stored) {
  const x = Math.min(1, stored.foot_point_similarity);
  const half = Math.sqrt(1 - x * x);
  // One scale for both; the labels need space on the right.
  const width = Math.max(X + R + 70, X + R * x + 150);
  return h(
    "figure",
    { class: "picture" },
    h(
      "div",
      { class: "columns" },
      view(edgeOn(x, half, width, describe(stored)), "Seen edge on: the line is the set."),
      view(fromTheFront(half, width, stored), "Seen along the line from the origin to the foot point."),
    ),
    h("figcaption", {}, h("p", {}, describe(stored)), h("p", { class: "fine" }, legend(stored))),
  );
}

const view = (drawing, words) => h("div", {}, drawing, h("p", { class: "view" }, words));

function edgeOn(x, half, width, words) {
  const at = (right, up) => [X + R * right, Y - R * up];
  const [fx, fy] = at(x, 0);
  const [px, py] = at(x, half);
  const [, top] = at(x, half + 0.2);
  const [, bottom] = at(x, -half - 0.2);
  const arc = 30;
  const [ax, ay] = [X + arc * x, Y - arc * half];
  return s(
    "svg",
    { viewBox: `0 0 ${width} 344`, role: "img", "aria-label": words },
    s("circle", { class: "sphere", cx: X, cy: Y, r: R }),
    s("line", { class: "axis", x1: X, y1: Y, x2: fx, y2: fy }),
    s("line", { class: "axis", x1: X, y1: Y, x2: px, y2: py }),
    s("path", { class: "angle", d: `M ${X + arc} ${Y} A ${arc} ${arc} 0 0 0 ${ax} ${ay}` }),
    s("line", { class: "subspace", x1: fx, y1: top, x2: fx, y2: bottom }),
    dot("candidate", at(x, -half), 5),
    dot("origin", [X, Y], 3.5),
    dot("foot", [fx, fy], 6),
    dot("face", [px, py], 7),
    label("unit sphere", X - R * 0.42, Y + R * 0.55, "middle"),
    label("origin", X - 10, Y + 5, "end"),
    label("foot point", fx + 13, fy - 2),
    label(`‖p‖ = ${x.toFixed(3)}`, fx + 13, fy + 16),
    label("the face", px + 14, py - 4),
    label("another candidate", fx + 13, Y + R * half + 20),
    label(`${angle(x).toFixed(1)}°`, ax - 7, ay - 2, "end"),
  );
}

function fromTheFront(half, width, stored) {
  const rim = R * half;
  const count = Math.min(stored.decoys ?? 0, SHOWN);
  // Only the distance from the foot point is true; the directions are an illustration.
  const place = (index) => {
    const turn = 0.13 + (index + 0.22 * Math.sin(5 * index)) / (count + 1);
    return [X + rim * Math.cos(2 * Math.PI * turn), Y - rim * Math.sin(2 * Math.PI * turn)];
  };
  const [px, py] = place(0);
  const words =
    `Seen along the line from the origin to the foot point, a circle of radius ${half.toFixed(3)} around ` +
    "the foot point holds the candidates: the face" +
    (count ? ", and the decoys, as far from the foot point as the face." : ".");
  return s(
    "svg",
    { viewBox: `0 0 ${width} 344`, role: "img", "aria-label": words },
    s("circle", { class: "rim", cx: X, cy: Y, r: rim }),
    s("line", { class: "axis", x1: X, y1: Y, x2: X - rim, y2: Y }),
    Array.from({ length: count }, (_, index) => dot("decoy", place(index + 1), 7)),
    dot("foot", [X, Y], 6),
    dot("face", [px, py], 7),
    label("foot point", X, Y + 24, "middle"),
    label(`√(1 − ‖p‖²) = ${half.toFixed(3)}`, X, Y - 14, "middle"),
    label("the face", px + 14, py - 6),
    count ? label("decoys", X + rim - 18, Y + 52, "end") : null,
  );
}

function legend(stored) {
  const seen =
    "Angle and lengths are to scale. In both views the set is shown in one or two of its " +
    `${stored.m} dimensions. `;
  if (stored.decoys === null) return seen + "How it was lifted is not known: it belongs to another contract.";
  if (stored.decoys === 0) {
    return seen + "Its directions are random, without decoys, so it conceals next to nothing.";
  }
  const whose = session.contract.generator ? "faces that nobody has" : "faces of other people";
  return (
    seen +
    `${stored.enrolled_by === "template" ? "By the contract, the" : "The"} set passes through ` +
    `${stored.decoys} decoys, ${whose}` +
    `${stored.decoys > SHOWN ? ` (${SHOWN} are drawn)` : ""}. Each lies on the rim, as far from the foot ` +
    "point as the face; only the drawing marks which is which. Their directions are not stored, so those " +
    "are an illustration; seen edge on, most would stand near the foot point. “Equally a candidate” holds " +
    "for the set alone: what an attacker who knows more gets is for an audit to say."
  );
}
