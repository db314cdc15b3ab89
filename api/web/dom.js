// Elements from code: no text is ever parsed as markup.

const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes ?? {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "value") node.value = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((each) => each !== null && each !== undefined));
  return node;
}

export const h = (tag, attributes, ...children) =>
  fill(document.createElement(tag), attributes, children);

export const s = (tag, attributes, ...children) =>
  fill(document.createElementNS(SVG, tag), attributes, children);

// A command, not broken within an option.
export const command = (text) =>
  h("code", {}, text.split(" ").map((word) => [h("span", {}, word), " "]).flat().slice(0, -1));

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

// A box around a face, over a picture that fills its frame.
export function faceBox() {
  const box = s("rect", { class: "found", hidden: true });
  const overlay = s("svg", { class: "overlay", preserveAspectRatio: "xMidYMid slice", "aria-hidden": "true" }, box);
  // `found` is x1, y1, x2, y2 in pixels of a picture of this size, or null.
  const mark = (found, width, height) => {
    box.toggleAttribute("hidden", !found);
    if (!found) return;
    overlay.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const [x, y, right, bottom] = found;
    const places = { x, y, width: right - x, height: bottom - y, rx: width / 80 };
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

const row = ([first, ...rest]) =>
  h("tr", {}, h("th", { scope: "row" }, first), rest.map((each) => h("td", {}, each)));

// A table that scrolls by itself where it is too wide; the keyboard reaches it.
export function table(caption, head, rows) {
  return h(
    "div",
    { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h(
      "table",
      {},
      h("caption", {}, caption),
      h("thead", {}, h("tr", {}, head.map((each) => h("th", { scope: "col" }, each)))),
      h("tbody", {}, rows.map(row)),
    ),
  );
}

// Ask in a modal dialog, with the focus on the answer that does nothing; resolves to whether the visitor agreed.
// It closes unanswered when `signal` ends.
export function confirmed(title, text, verb, signal) {
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

export const percent = (rate) =>
  rate === null || rate === undefined ? "unknown" : `${Number((100 * rate).toPrecision(3))} %`;

export const oneIn = (rate) => (rate > 0 ? `1 in ${Math.round(1 / rate).toLocaleString("en")}` : "none seen");

export function when(text) {
  if (!text) return "never";
  const time = new Date(text);
  return h(
    "time",
    { datetime: text },
    time.toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" }),
  );
}

export const bytes = (count) => `${count.toLocaleString("en")} bytes`;

export function download(name, text, type = "application/json") {
  const url = URL.createObjectURL(new Blob([text], { type }));
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

// Of a drag: whether it carries files, and whether what it is over takes them by itself.
export const carriesFiles = (event) => event.dataTransfer?.types.includes("Files") ?? false;
export const takesFiles = (target) => target.closest?.("input[type=file]:enabled") != null;
