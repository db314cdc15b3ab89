// What went wrong, in words: the problem, what to do, and what support will ask for.

import { h } from "./dom.js";

export const DEMO = document.documentElement.dataset.demo === "yes";

const REMEDIES = {
  forbidden: "Reload the page. If that does not help, ask the operator for a key that may do this.",
  unauthorized: "Check the API key: it may be mistyped, revoked or expired.",
  not_enrolled: "Check the id, or enroll the person first.",
  not_found: "The service has nothing at this address. It may have been updated: reload the page.",
  contract_mismatch: "Reload the page. If that does not help, enroll this person again: the contract has changed.",
  unsupported_image: "Send a JPEG, PNG or WebP photo.",
  image_too_large: "Send a smaller photo.",
  multiple_faces: "Under Options, the largest face can be taken.",
  uncalibrated: "Choose another level.",
  locked_out: "Wait, or sign in another way. An operator can lift the lock.",
  rate_limited: "Wait, then try again.",
  enrollment_conflict: "This person was enrolled or erased meanwhile. Look them up, and enroll them again if need be.",
  passkey_refused: "Try again, on the device that has the passkey. If it is lost, enroll the person again.",
  passkey_unsupported: "Use another device or browser. If a passkey was made just now, delete it.",
  passkey_of_another: "Choose the passkey that is named after the id. If it is lost, enroll the person again.",
  replayed: "Start again: it came too late, or twice.",
  unusable_contract: "Reload the page, or switch private mode off: photos then go to the service.",
  camera: "See that no other program uses the camera, and try again.",
  private_camera: "See that no other program uses the camera, and try again, or switch private mode off and choose files.",
  unreachable: "Check your connection and that the service is running, then try again.",
  connection_failed: "Check your connection and that the service is running, then try again.",
};

// Their messages end with what to do.
const SAYS_IT = ["no_face", "face_too_small", "low_quality", "inconsistent_images"];

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

// Live guidance: one line for what the service saw in a photo.
export function guidance({ code, details, message, box }) {
  // A pack without a detector takes crops of a face, and measures no box.
  if (code === null) return box ? "Good: one face, large and clear enough." : "Good: clear enough.";
  if (code === "multiple_faces") return `${details.faces ?? "Several"} faces found. Come closer, into the middle.`;
  return sentence(message);
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export const sentence = (text) => capital(text) + (/[.!?]$/.test(text) ? "" : ".");

const duration = (seconds) => (seconds < 120 ? `${seconds} s` : `${Math.round(seconds / 60)} minutes`);

// What to do; nothing where the message of a photo, or the wait, says it.
function advice(problem) {
  const { code = "page_error", details, retryAfter } = problem;
  if (details?.disabled) return "This person is locked out until an operator lifts the lock.";
  if (SAYS_IT.includes(code) || (code === "rate_limited" && retryAfter)) return null;
  return REMEDIES[code] ?? "Try again in a moment. If it keeps happening, tell the operator.";
}

// An alert; it is read out when it is put on the page.
export function problemBox(problem) {
  const { code = "page_error", details, requestId, retryAfter, title, message } = problem;
  const text = advice(problem);
  return h(
    "div",
    { class: "problem", role: "alert" },
    h("p", { class: "problem-title" }, title ?? TITLES[code] ?? sentence(message)),
    text && h("p", {}, text),
    retryAfter && !details?.disabled ? h("p", {}, `Try again in ${duration(retryAfter)}.`) : null,
    h("p", { class: "fine" }, "Code ", h("code", {}, code), requestId ? [", request ", h("code", {}, requestId)] : null),
  );
}

export const lacking = (right) =>
  `Switched off: this key does not have the right “${right}”. ` +
  "An operator can create one that does: veilface keys create --right " + right;
