// What went wrong, in words: the problem, what to do, and what support will ask for.

import { h } from "./dom.js";

export const DEMO = document.documentElement.dataset.demo === "yes";

const REMEDIES = {
  unauthorized: "Check the API key: it may be mistyped, revoked or expired.",
  not_enrolled: "Check the id, or enroll the person first.",
  not_found: "The service has nothing at this address. It may have been updated: reload the page.",
  contract_mismatch: "Reload the page and try again. If that does not help, this person was enrolled under an earlier contract: enroll them again.",
  unsupported_image: "Send a JPEG, PNG or WebP photo.",
  image_too_large: "Send a smaller photo.",
  request_too_large: "Send fewer or smaller photos.",
  too_many_images: "Send fewer photos.",
  no_face: "Come closer, and take a photo that shows the face upright and uncovered.",
  multiple_faces: "Come closer, into the middle, or take the largest face, under Options.",
  face_too_small: "Move closer, or send a larger photo.",
  low_quality: "Take another photo.",
  inconsistent_images: "Remove the photos that show somebody else or look very different.",
  uncalibrated: "Choose another level.",
  validation_failed: "Correct the field and try again.",
  locked_out: "Wait, or sign in another way. An operator can lift the lock.",
  rate_limited: "Wait, then try again.",
  overloaded: "Try again in a moment.",
  store_unavailable: "Try again in a moment. If it keeps happening, tell the operator.",
  model_unavailable: "Try again in a moment. If it keeps happening, tell the operator.",
  enrollment_conflict: "This person was enrolled or erased meanwhile. Look them up, and enroll them again if need be.",
  passkey_refused: "Try again, on the device that has the passkey. If it is lost, enroll the person again.",
  passkey_unsupported: "Use another device or browser. If a passkey was made just now, delete it.",
  passkey_of_another: "Choose the passkey that is named after the id. If it is lost, enroll the person again.",
  replayed: "Start again: it came too late, or twice.",
  private_mode: "Reload the page, or switch private mode off: photos then go to the service.",
  lifted_before: "Choose another photo.",
  camera: "See that no other program uses the camera, and try again.",
  internal_error: "Report the request id to the operator.",
  unreachable: "Check your connection and that the service is running, then try again.",
};

// What to do where something is forbidden, by what the details name.
const FORBIDDEN = {
  missing: "Ask the operator for a key that has this right.",
  lowest_level: "Choose a stricter level, or ask the operator for another key.",
  tenant_setting: "Switch private mode off: photos then go to the service.",
  liveness: "Reload the page: what this service asks for has changed.",
};

function remedy({ code, details }) {
  if (code !== "forbidden") return REMEDIES[code] ?? "Reload the page and try again.";
  const reason = Object.keys(FORBIDDEN).find((name) => name in details);
  return FORBIDDEN[reason] ?? "Ask the operator whether this key may do it.";
}

// What a movement is called, and where its arrow points: in the picture, which is a mirror.
export const FRONT = "front";
export const MOVE_BACK = "move_back";
export const MOVEMENTS = {
  [FRONT]: ["Look straight ahead", "●"],
  [MOVE_BACK]: ["Move back and look straight ahead", "●"],
  turn_left: ["Turn your head to the left", "←"],
  turn_right: ["Turn your head to the right", "→"],
  look_up: ["Look up", "↑"],
  look_down: ["Look down", "↓"],
  come_closer: ["Come closer", "⤢"],
};

// For a list of facts; why it failed is told to some keys only.
export function livenessWords({ liveness, liveness_failure: why }) {
  if (liveness === "not_checked") return null;
  if (liveness === "passed") return "passed, as a good print, a screen or a recording may";
  return why ? `failed (${why.replaceAll("_", " ")})` : liveness;
}

export function cameraTrouble(error) {
  if (!navigator.mediaDevices) return "browsers allow the camera only over HTTPS or on localhost";
  if (error?.name === "NotAllowedError") return "camera access was denied. Allow it in the browser’s settings for this page";
  if (error?.name === "NotFoundError") return "no camera was found";
  return "the camera cannot be used: another program may have it";
}

// The service writes for programs, the page for people.
const TITLES = {
  unauthorized: "The service does not accept this API key.",
  locked_out: "Too many failed attempts for this person.",
};

const QUALITY = {
  score: "The face is hard to see: uncover it and look at the camera",
  blur: "Blurred: hold still, and clean the lens",
  darkness: "Too dark: find more light",
  brightness: "Too bright: find softer light",
  turned: "Not upright: hold the camera upright, or turn the photo",
  pose: "Turned away: look straight at the camera",
  hidden: "Part of the face is hidden: show all of it, with some room around it",
};

export const qualityWords = (details) =>
  Object.keys(QUALITY)
    .filter((name) => name in details)
    .map((name) => QUALITY[name]);

// Live guidance: one line for what the service saw in a photo.
export function guidance(check) {
  switch (check.code) {
    case null:
      // A pack without a detector takes crops of a face, and measures no box.
      return check.box ? "Good: one face, large and clear enough." : "Good: clear enough.";
    case "no_face":
      if (DEMO) return "No cartoon face found. The demo model sees no others: choose a cartoon person.";
      return "No face found. Come closer, and face the camera with your head upright.";
    case "multiple_faces":
      return `${check.details.faces ?? "Several"} faces found. Come closer, into the middle, until yours is much the largest.`;
    case "face_too_small":
      return "The face is too small. Move closer.";
    default:
      return `${qualityWords(check.details).join(". ") || check.message}.`;
  }
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export const sentence = (text) => capital(text) + (/[.!?]$/.test(text) ? "" : ".");

function duration(seconds) {
  if (seconds < 120) return `${seconds} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} minutes`;
  return `${Math.round(seconds / 3600)} hours`;
}

// An alert; it is read out when it is put on the page.
export function problemBox(problem) {
  const code = problem.code ?? "page_error";
  const remedies = code === "low_quality" ? qualityWords(problem.details) : [];
  const disabled = problem.details?.disabled;
  return h(
    "div",
    { class: "problem", role: "alert" },
    h("p", { class: "problem-title" }, problem.title ?? TITLES[code] ?? sentence(problem.message)),
    remedies.length
      ? h("ul", {}, remedies.map((each) => h("li", {}, `${each}.`)))
      : code === "rate_limited" && problem.wait
        ? null
        : h(
            "p",
            {},
            disabled
              ? "This person is locked out until an operator lifts the lock."
              : remedy(problem),
          ),
    problem.wait && !disabled ? h("p", {}, `Try again in ${duration(problem.wait)}.`) : null,
    h(
      "p",
      { class: "fine" },
      "Code ",
      h("code", {}, code),
      problem.requestId ? ", request " : null,
      problem.requestId ? h("code", {}, problem.requestId) : null,
    ),
  );
}

export const lacking = (right) =>
  `Switched off: this key does not have the right “${right}”. ` +
  "An operator can create one that does: veilface keys create --right " + right;
