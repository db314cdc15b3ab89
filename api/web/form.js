// A form that takes a person's id and photos, and beside it what comes of it.

import { folded, h } from "./dom.js";
import { holderKey } from "./holder.js";
import { photoPicker } from "./photos.js";
import { Problem, call, session } from "./service.js";
import { offNote, subjectField, switchOf, whyOff } from "./subject.js";
import { cameraTrouble, problemBox } from "./words.js";

// What differs between the views: `action`, `title` and `lead`; `most` photos, and whether new ones replace them and the
// camera's are sent at once (`replaces`); `beside` the id; `level()`; `movements`, and whether they are asked for
// (`moving()`); `verb` on the button; `progress(count)`, words below it; `empty(lifts)`, shown until there is an outcome.
// `send(name, given, say)` resolves to an answer, or to null where the visitor gave up; `token(name)` says what else a token
// for private mode is asked for with; `show(name, answer)` makes the outcome, which is about this person and these
// photos, and with `always` is shown whatever else was chosen meanwhile.
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
  const say = (text) => (send.textContent = progress.textContent = text);
  const moving = () => on && (view.moving?.() ?? false);
  // Counts what was asked: an answer to what is no longer on the page is not shown.
  let asked = 0;
  const clear = () => {
    asked += 1;
    result.replaceChildren();
    problem.replaceChildren();
  };
  const changed = () => {
    clear();
    rest();
  };
  const picker = on ? photoPicker({ most: view.most, sends: replaces ? view.verb : null, onchange: changed }) : null;
  const mode = on ? session.mode?.privateMode(action, { authorize, onchange: refresh, onresult, onerror }) : null;
  const lifts = () => mode?.active() ?? false;
  const holder = holderKey(action, clear);

  // The level was changed, or private mode switched.
  function refresh() {
    clear();
    mode?.at(view.level?.());
    if (view.movements) view.movements.root.hidden = !moving();
    if (picker) {
      picker.root.hidden = moving() || lifts();
      if (picker.root.hidden) picker.start();
      if (lifts()) picker.drop(picker.chosen());
    }
    rest();
  }

  // What the button does next, and what becomes of the photos.
  function rest() {
    empty.replaceChildren(view.empty(lifts()));
    mode?.login.setAttribute("face", picker.face() || "dominant");
    // Until the attempt is over, the button tells how far it is.
    if (on && fields.disabled) return;
    send.textContent = moving() ? "Start head movements" : view.verb;
    send.disabled = !(moving() || picker?.ready());
    send.hidden = !moving() && (picker?.hasShutter() ?? false);
    act.hidden = lifts();
    const words = picker ? (view.progress?.(picker.chosen().length) ?? "") : "";
    // Only what changed is read out.
    if (words !== progress.textContent) progress.textContent = words;
  }

  async function submit(event) {
    event.preventDefault();
    if (fields.disabled || lifts()) return;
    const pressed = document.activeElement;
    clear();
    fields.disabled = true;
    await attempt();
    fields.disabled = false;
    rest();
    // A button that is switched off loses the focus.
    if (document.activeElement === document.body) pressed.focus();
  }

  async function attempt() {
    const asking = asked;
    const name = subject.id();
    const sent = picker.chosen();
    let given = { photos: picker.blobs(), face: picker.face() };
    try {
      await subject.searched();
      const holder_key = await holder.key(name, say);
      if (moving()) given = await view.movements.frames(name);
      const answer = await view.send(name, { ...given, holder_key }, say);
      fields.disabled = false;
      if (!answer || !(view.always || asking === asked)) return;
      if (!replaces) picker.drop(sent);
      succeed(name, answer);
    } catch (error) {
      fields.disabled = false;
      if (view.always || asking === asked) fail(error);
    }
  }

  function succeed(name, answer) {
    const outcome = view.show(name, answer);
    // The field says who is enrolled by now.
    if (action === "enroll") subject.input.dispatchEvent(new Event("input"));
    result.replaceChildren(outcome);
    if (outcome.hasAttribute("tabindex")) outcome.focus();
    result.scrollIntoView({ block: "nearest" });
  }

  function fail(error) {
    problem.replaceChildren(problemBox(error));
    problem.scrollIntoView({ block: "nearest" });
  }

  // Whom the element of private mode was given a token for last.
  let authorized = "";

  async function authorize() {
    clear();
    authorized = subject.id();
    await subject.searched();
    mode.login.toggleAttribute("passkey", holder.wanted());
    const json = { subject_id: authorized, action, ...(await view.token(authorized)) };
    return { subject: authorized, token: (await call("POST", "/v1/tokens", { json })).token };
  }

  function onresult(answer) {
    succeed(authorized, answer);
  }

  function onerror(error) {
    // About photos, and where the visitor gave up, the element has said it.
    if (error.name === "AbortError" || session.client.isPhotoRefused(error)) return;
    // The browser's own exceptions are about the camera.
    const isCamera = error instanceof DOMException;
    fail(isCamera ? new Problem({ code: "private_camera", message: cameraTrouble(error) }) : error);
  }

  // A token is for a person: without an id the element's button does nothing.
  const needsId = (event) => subject.input.reportValidity() || event.stopPropagation();
  mode?.login.addEventListener("click", needsId, { capture: true });

  const act = h("div", { class: "act-part" }, progress, send);
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
    h("div", { class: "card photo-part" }, picker?.root, on ? view.movements?.root : null, mode?.login, switchOf(mode)),
    act,
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
