// A form that takes a person's id and photos, and beside it what comes of it.

import { folded, h } from "./dom.js";
import { holderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { session } from "./service.js";
import { offNote, subjectField, switchOf, whyOff } from "./subject.js";
import { problemBox } from "./words.js";

// What differs between the views: `action`, `title` and `lead`; `most` photos, and whether new ones replace them and the
// camera's are sent at once (`replaces`); `beside` the id; `level()`; `movements`, and whether they are asked for
// (`moving()`); `verb` on the button; `progress(count)`, words below it; `empty`, shown until there is an outcome.
// `send(name, given, tools)` resolves to an answer, or to null where the visitor gave up; `show(name, answer, tools)` makes
// the outcome of it, which is about this person and these photos, and with `always` is shown whatever else was chosen
// meanwhile; `remedies(error, name, tools)` go with a problem.
export function photoForm(id, view) {
  const { action, replaces = false } = view;
  const why = whyOff(action);
  const on = why === null;
  const ended = new AbortController();
  const subject = subjectField(id, action, (person) => holder.showLock(person), ended.signal);
  const problem = h("div", {});
  const result = h("div", { class: "result", role: "status" });
  const progress = h("div", { class: "progress", role: "status" });
  const empty = h("div", { class: "empty" });
  const send = h("button", { type: "submit", class: "primary", disabled: true });
  // A button's text is not read out when it changes.
  const heard = h("p", { class: "unseen", role: "status" });
  const say = (text) => (send.textContent = heard.textContent = text);
  const moving = () => on && (view.moving?.() ?? false);
  // Counts what was asked: an answer to what is no longer on the page is not shown.
  let asked = 0;
  const clear = () => {
    asked += 1;
    result.replaceChildren();
    problem.replaceChildren();
  };
  const changed = () => {
    rest();
    if (!shooting) clear();
  };
  let shooting = false;
  const picker = on ? photoPicker({ most: view.most, replaces, shutter: !replaces, onchange: changed, onsource: () => rest() }) : null;
  const mode = on ? session.mode?.offer(action, refresh) : null;
  const holder = holderKey(action, clear);
  // The camera whose photos are sent as soon as they are taken.
  const shutter = () => (replaces && !moving() ? (picker?.live() ?? null) : null);

  // The level was changed, or private mode switched.
  function refresh() {
    clear();
    mode?.at(view.level?.(), picker);
    if (view.movements) view.movements.root.hidden = !moving();
    if (picker) {
      picker.root.hidden = moving();
      if (moving()) picker.start();
    }
    rest();
  }

  // What the button does next, and what becomes of the photos.
  function rest() {
    empty.replaceChildren(view.empty());
    // Until the attempt is over, the button tells how far it is.
    if (on && fields.disabled) return;
    const camera = shutter();
    const starts = camera !== null && !camera.isOn();
    send.textContent = starts ? "Start camera" : moving() ? "Start head movements" : view.verb;
    heard.textContent = "";
    send.disabled = !(camera || moving() || picker?.ready());
    send.formNoValidate = starts;
    if (!picker || !view.progress) return;
    const words = view.progress(picker.chosen().length);
    // Only what changed is read out.
    if (words !== progress.textContent) progress.textContent = words;
  }

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled) return;
    clear();
    const camera = shutter();
    fields.disabled = shooting = true;
    let goes = true;
    if (camera?.isOn()) {
      say("Hold still…");
      const burst = await camera.burst();
      goes = burst.length > 0 && root.isConnected;
      if (goes) picker.take(burst);
    } else if (camera) {
      say("Starting…");
      await camera.begin();
      goes = false;
    }
    shooting = false;
    if (goes) await attempt();
    fields.disabled = false;
    rest();
    // A button that is switched off loses the focus.
    if (document.activeElement === document.body) send.focus();
  }

  async function attempt() {
    const asking = asked;
    const name = subject.id();
    const sent = picker.chosen();
    const lifts = session.mode?.active() ? session.mode : null;
    const tools = { lifts, say, drop: () => picker.drop(sent), problem, send };
    let given = { photos: picker.blobs(), face: picker.face() };
    let answer = null;
    let failure = null;
    try {
      await subject.searched();
      const holder_key = await holder.key(name, say);
      if (moving()) given = await view.movements.frames(name);
      answer = await view.send(name, { ...given, holder_key }, tools);
    } catch (error) {
      failure = error;
    }
    fields.disabled = false;
    if (!view.always && asking !== asked) return;
    if (failure) {
      if (failure.details && !moving()) picker.blame(failure, sent);
      problem.replaceChildren(problemBox(failure), ...view.remedies(failure, name, tools));
      problem.scrollIntoView({ block: "nearest" });
    } else if (answer) {
      const outcome = view.show(name, answer, tools);
      // The field says who is enrolled by now.
      if (action === "enroll") subject.input.dispatchEvent(new Event("input"));
      result.replaceChildren(outcome);
      if (outcome.hasAttribute("tabindex")) outcome.focus();
      result.scrollIntoView({ block: "nearest" });
    }
  }

  const fields = h(
    "fieldset",
    { class: "plain", disabled: !on },
    h(
      "div",
      { class: "card who-part" },
      subject.part,
      view.beside,
      on ? folded(action === "verify" ? "Options" : "Options: lock to a passkey, largest face", holder.parts, picker.option) : null,
    ),
    h("div", { class: "card photo-part" }, picker?.root, on ? view.movements?.root : null, switchOf(mode)),
    h("div", { class: "act-part" }, progress, send, heard),
  );
  const outcome = h("div", { class: "outcome" }, problem, result, empty);
  const form = h("form", { class: "work", onsubmit: submit }, fields, outcome);
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, view.title),
    h("p", { class: "lead" }, view.lead),
    offNote(why),
    form,
  );
  if (replaces) subject.input.addEventListener("input", clear);
  picker?.dropOn(form);
  picker?.start();
  refresh();
  return {
    root,
    refresh,
    stop() {
      asked += 1;
      ended.abort();
      view.stop?.();
      view.movements?.stop();
      holder.stop();
      picker?.stop();
    },
  };
}
