// Elements from code: no text is ever parsed as markup.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "value") node.value = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return node;
}

export const h = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);

export const s = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

// A command, not broken within an option.
export const command = (text) =>
  h("code", {}, text.split(" ").flatMap((word) => [" ", h("span", {}, word)]).slice(1));

let last = 0;
export const newId = (name) => `${name}-${++last}`;

// A labelled control, with a hint that belongs to it.
export function field(label, control, hint) {
  control.id ||= newId("field");
  const parts = [h("label", { for: control.id }, label), control];
  if (hint) {
    const id = `${control.id}-hint`;
    control.setAttribute("aria-describedby", id);
    parts.push(h("p", { class: "hint", id }, hint));
  }
  return h("div", { class: "field" }, parts);
}

// One of several: radio buttons in a row. `choices` has a label by each value.
export function choice(legend, choices, { value, onchange }) {
  const name = newId("choice");
  const radios = Object.keys(choices).map((each) =>
    h("input", { type: "radio", name, id: newId("choice"), value: each, checked: each === value, onchange: () => onchange(each) }),
  );
  const root = h(
    "fieldset",
    { class: "choice" },
    h("legend", {}, legend),
    radios.map((radio) => h("span", {}, radio, h("label", { for: radio.id }, choices[radio.value]))),
  );
  return { root, value: () => radios.find((radio) => radio.checked).value };
}

// A box around a face, over a picture that fills its frame.
export function faceBox() {
  const box = s("rect", { class: "found", hidden: true });
  const overlay = s("svg", { class: "overlay", preserveAspectRatio: "xMidYMid slice", "aria-hidden": "true" }, box);
  // `corners` are x1, y1, x2, y2 in pixels of a picture of this size, or null.
  const mark = (corners, width, height) => {
    box.toggleAttribute("hidden", !corners);
    if (!corners) return;
    overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const [x, y, right, bottom] = corners;
    const places = { x, y, width: right - x, height: bottom - y, rx: width / 40 };
    for (const [name, value] of Object.entries(places)) box.setAttribute(name, value);
  };
  return { overlay, mark };
}

// Terms and values; a value that is null is left out.
export function facts(pairs) {
  return h(
    "dl",
    { class: "facts" },
    pairs
      .filter(([, value]) => value !== null && value !== undefined)
      .map(([term, value]) => h("div", {}, h("dt", {}, term), h("dd", {}, value))),
  );
}

// What few visitors need, behind a line that opens it.
export const folded = (summary, ...content) =>
  h("details", {}, h("summary", {}, summary), h("div", { class: "inside" }, content));

// Ask in a modal dialog, with the focus on the answer that does nothing; resolves to whether the visitor agreed.
// It closes unanswered when `signal` ends, and does not open after that.
export async function confirmed(title, text, verb, signal) {
  if (signal.aborted) return false;
  const id = newId("dialog");
  const answer = (value) => () => dialog.close(value);
  const dialog = h(
    "dialog",
    { "aria-labelledby": `${id}-title`, "aria-describedby": `${id}-text` },
    h("h2", { id: `${id}-title` }, title),
    h("p", { id: `${id}-text` }, text),
    h(
      "p",
      { class: "row" },
      h("button", { type: "button", class: "secondary", onclick: answer("keep") }, "Keep"),
      h("button", { type: "button", class: "danger", onclick: answer("agreed") }, verb),
    ),
  );
  signal.addEventListener("abort", answer("ended"));
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "agreed");
    });
  });
}

export const plural = (count, one, many) => `${count.toLocaleString("en")} ${count === 1 ? one : many}`;

export const percent = (rate) =>
  rate === null || rate === undefined ? "unknown" : `${Number((100 * rate).toPrecision(3))} %`;

export const oneIn = (rate) => (rate > 0 ? `1 in ${Math.round(1 / rate).toLocaleString("en")}` : "none seen");

// A time to the second; `brief`: to the day.
export function when(text, { brief = false } = {}) {
  const time = new Date(text);
  const shown = time.toLocaleString("en-GB", brief ? { dateStyle: "medium" } : { dateStyle: "medium", timeStyle: "medium" });
  return h("time", { datetime: text }, shown);
}

export function download(name, text) {
  const url = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

// Whether a drag carries files.
export const carriesFiles = (event) => event.dataTransfer?.types.includes("Files") ?? false;
