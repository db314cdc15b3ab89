// A challenge of head movements: the page says each by the clock, and takes frames meanwhile. It does not wait until it
// sees one: a recording that shows all movements in turn would be waited for, too.

import { after, viewfinder } from "./camera.js";
import { h } from "./dom.js";
import { Problem, call } from "./service.js";
import { FRONT, MOVE_BACK, MOVEMENTS } from "./words.js";

const SIDE = 960;
const READY_MS = 2500;
// Frames of one movement: two on the way out, one back at the front.
const OUT_MS = [1200, 600];
const BACK_MS = 1300;

// `frames(subject)` resolves to {challenge_id, photos}.
export function headMovements() {
  const arrow = h("span", { class: "arrow", "aria-hidden": "true" });
  const words = h("span", {});
  const movement = h("p", { class: "movement", role: "status", "aria-live": "assertive", hidden: true }, arrow, words);
  const finder = viewfinder(movement);
  let running = new AbortController();

  function say(name) {
    [words.textContent, arrow.textContent] = MOVEMENTS[name];
    movement.dataset.movement = name;
    movement.hidden = false;
  }

  async function frames(subject) {
    running.abort();
    running = new AbortController();
    const run = running;
    const { signal } = run;
    try {
      await finder.open(signal, () => run.abort(new Problem({ code: "camera", message: "the camera has stopped" })));
      say(FRONT);
      finder.root.scrollIntoView({ block: "nearest" });
      await after(READY_MS);
      signal.throwIfAborted();
      // Asked for now: its minute has begun.
      const challenge = await call("POST", "/v1/challenges", { json: { subject_id: subject }, signal });
      const photos = [await snap(signal)];
      for (const asked of challenge.movements) {
        say(asked);
        for (const wait of OUT_MS) photos.push(await snap(signal, wait));
        say(asked === "come_closer" ? MOVE_BACK : FRONT);
        photos.push(await snap(signal, BACK_MS));
      }
      return { challenge_id: challenge.challenge_id, photos };
    } catch (error) {
      throw signal.reason instanceof Problem ? signal.reason : error;
    } finally {
      run.abort();
      if (running === run) movement.hidden = true;
    }
  }

  async function snap(signal, wait = 0) {
    await after(wait);
    signal.throwIfAborted();
    return finder.shot({ side: SIDE });
  }

  const root = h(
    "div",
    { class: "head-movements" },
    finder.root,
    h(
      "p",
      { class: "hint" },
      "You are asked for three head movements, for about twelve seconds. Keep your face inside the outline. ",
      "If you cannot turn your head, ask the operator for another way.",
    ),
  );
  return { root, frames, stop: () => running.abort() };
}
