// Elements from code: no text is ever parsed as markup.

export function h(tag, attributes, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "value") node.value = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined));
  return node;
}

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
  const dialog = h(
    "dialog",
    { "aria-labelledby": `${id}-title`, "aria-describedby": `${id}-text` },
    h("h2", { id: `${id}-title` }, title),
    h("p", { id: `${id}-text` }, text),
    h(
      "form",
      { method: "dialog", class: "row" },
      h("button", { class: "secondary", value: "keep" }, "Keep"),
      h("button", { class: "danger", value: "agreed" }, verb),
    ),
  );
  signal.addEventListener("abort", () => dialog.close());
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
