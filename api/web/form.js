// A form that takes a person's id and photos, and beside it what comes of it.

import { h } from "./dom.js";
import { holderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { session } from "./service.js";
import { offNote, subjectField, switchOf, whyOff } from "./subject.js";
import { problemBox } from "./words.js";

// What differs between the views: `action`, `title`, `lead`, `idHint` and `heading` (of `steps`, which are shown
// until there is an outcome); `most` photos, and whether new ones replace them (`replaces`); `beside` the id; `level()`;
// `movements`, and whether they are asked for (`moving()`); `verb()` on the button. `send(name, given, tools)` resolves
// to an answer, or to null where the visitor gave up; `show(name, answer, tools)` makes the outcome of it, which is about
// this person and these photos, and with `always` is shown whatever else was chosen meanwhile; `remedies(error, name, tools)`
// go with a problem.
export function photoForm(id, view) {
  const { action } = view;
  const why = whyOff(action);
  const on = why === null;
  const [subject, subjectPart] = subjectField(id, view.idHint);
  const problem = h("div", {});
  const result = h("div", { class: "result", role: "status" });
  const send = h("button", { type: "submit", disabled: true });
  const steps = view.steps().map((step) => h("li", {}, step));
  const say = (text) => (send.textContent = text);
  const moving = () => on && (view.moving?.() ?? false);
  // Counts what was asked: an answer to what is no longer on the page is not shown.
  let asked = 0;
  const clear = () => {
    asked += 1;
    result.replaceChildren();
    problem.replaceChildren();
  };
  const picker = on
    ? photoPicker({
        most: view.most,
        replaces: view.replaces,
        onchange: (ready) => {
          send.disabled = !(ready || moving());
          clear();
        },
      })
    : null;
  const mode = on ? session.mode?.offer(action, refresh) : null;
  const holder = holderKey(action, subject, clear);

  // The level was changed, or private mode switched.
  function refresh() {
    clear();
    mode?.at(view.level?.(), picker);
    view.steps().forEach((step, index) => (steps[index].textContent = step));
    if (view.movements) view.movements.root.hidden = !moving();
    if (picker) {
      picker.root.hidden = moving();
      if (moving()) picker.pause();
    }
    rest();
  }

  function rest() {
    say(view.verb());
    send.disabled = !(moving() || picker?.ready());
  }

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled) return;
    clear();
    const asking = asked;
    const name = subject.value;
    const sent = picker.chosen();
    const lifts = session.mode?.active() ? session.mode : null;
    const tools = { lifts, say, drop: () => picker.drop(sent), problem, send };
    let shown = { photos: picker.blobs(), face: picker.face() };
    let answer = null;
    let failure = null;
    fields.disabled = true;
    try {
      const holder_key = await holder.key(name, say);
      if (moving()) shown = await view.movements.frames(name);
      answer = await view.send(name, { ...shown, holder_key }, tools);
    } catch (error) {
      failure = error;
    }
    fields.disabled = false;
    const left = () => (lifts && root.isConnected ? [lifts.whatLeft()] : []);
    if (view.always || asking === asked) {
      if (failure) {
        if (failure.details && !moving()) picker.blame(failure, sent);
        problem.replaceChildren(problemBox(failure), ...view.remedies(failure, name, tools), ...left());
        problem.scrollIntoView({ block: "nearest" });
      } else if (answer) {
        const outcome = view.show(name, answer, tools);
        // The field says who is enrolled by now.
        if (action === "enroll") subject.dispatchEvent(new Event("input"));
        result.replaceChildren(outcome, ...left());
        if (outcome.tabIndex === -1 && outcome.hasAttribute("tabindex")) outcome.focus();
        result.scrollIntoView({ block: "nearest" });
      }
    }
    rest();
    // A button that is switched off loses the focus.
    if (document.activeElement === document.body) send.focus();
  }

  const fields = h(
    "fieldset",
    { class: "plain", disabled: !on },
    view.beside ? h("div", { class: "pair" }, subjectPart, view.beside) : subjectPart,
    switchOf(mode),
    picker?.root,
    on ? view.movements?.root : null,
    holder.parts,
    send,
  );
  const form = h("form", { class: "card", onsubmit: submit }, fields);
  const root = h(
    "section",
    {},
    h("h1", { tabindex: "-1" }, view.title),
    h("p", { class: "lead" }, view.lead),
    offNote(why),
    h(
      "div",
      { class: "work" },
      form,
      h(
        "div",
        { class: "outcome" },
        problem,
        result,
        h("section", { class: "card empty" }, h("h2", {}, view.heading), h("ol", {}, steps)),
      ),
    ),
  );
  if (view.replaces) subject.addEventListener("input", clear);
  picker?.dropOn(form);
  refresh();
  return {
    root,
    refresh,
    stop() {
      asked += 1;
      view.stop?.();
      view.movements?.stop();
      holder.stop();
      picker?.stop();
    },
  };
}
