// What went wrong, in words: the problem, what to do, and what support will ask for.

import { h } from "./dom.js";

const DEMO = document.documentElement.dataset.demo === "yes";

const REMEDIES = {
  unauthorized: "Check the API key: it may have been mistyped, revoked, or have expired.",
  forbidden: "Ask the operator for a key with this right.",
  not_enrolled: "Check the id, or enroll this person first.",
  not_found: "The service has nothing there. Its version may differ from this page's: reload.",
  contract_mismatch: "This person was enrolled under an earlier contract: enroll them again.",
  unsupported_image: "Send a JPEG, PNG or WebP photo.",
  image_too_large: "Send a smaller photo.",
  request_too_large: "Send fewer or smaller photos.",
  too_many_images: "Send ten photos at most.",
  no_face: "Take a photo that shows the face upright and uncovered.",
  multiple_faces: "Take a photo that shows one person, or allow other people in the photo.",
  face_too_small: "Come closer, or send a larger photo.",
  low_quality: "Take another photo.",
  inconsistent_images: "Remove the photos that show another person, or look very unlike.",
  uncalibrated: "Choose another level.",
  validation_failed: "Correct the field and try again.",
  locked_out: "Wait, or use another factor. An operator can lift the lock.",
  rate_limited: "Wait, then try again.",
  overloaded: "Try again in a moment.",
  store_unavailable: "Try again in a moment; tell the operator if it lasts.",
  model_unavailable: "This service takes no photos. Ask its operator.",
  idempotency_conflict: "Wait a moment and try again.",
  export_superseded: "Export the subject again where it is enrolled.",
  internal_error: "Tell the operator the request id.",
  unreachable: "Check the connection, and that the service runs; then try again.",
};

// Where the service speaks to programs, the page speaks to people.
const TITLES = {
  unauthorized: "The service does not accept this API key.",
  // The service says for how long; the page counts that down, and one clock is enough.
  locked_out: "Too many failed attempts on this person.",
};

const QUALITY = {
  score: "The face is hard to see: uncover it and look into the camera",
  blur: "Blurred: hold still, and clean the lens",
  darkness: "Too dark: put more light on the face",
  brightness: "Too bright: put less light on the face",
  pose: "Turned away: look straight into the camera",
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
      if (DEMO) return "No drawn face found. The demo model sees no other: choose a drawn person.";
      return "No face found. Look into the camera, upright.";
    case "multiple_faces":
      return `${check.details.faces ?? "Several"} faces found. Only one person may be in the picture.`;
    case "face_too_small":
      return "The face is too small. Come closer.";
    default:
      return `${qualityWords(check.details).join(". ") || check.message}.`;
  }
}

const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export const sentence = (text) => capital(text) + (/[.!?]$/.test(text) ? "" : ".");

function waiting(seconds) {
  const shown = h("strong", {}, duration(seconds));
  const until = Date.now() + 1000 * seconds;
  const timer = setInterval(() => {
    const left = Math.ceil((until - Date.now()) / 1000);
    if (left > 0 && shown.isConnected) shown.textContent = duration(left);
    else {
      if (left <= 0) line.textContent = "You can try again now.";
      clearInterval(timer);
    }
  }, 1000);
  // Not read out every second: the alert told the time once.
  const line = h("p", { "aria-live": "off" }, "Try again in ", shown, ".");
  return line;
}

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
    h("p", { class: "problem-title" }, TITLES[code] ?? sentence(problem.message)),
    remedies.length
      ? h("ul", {}, remedies.map((each) => h("li", {}, `${each}.`)))
      : h(
          "p",
          {},
          disabled
            ? "This person waits for an operator, who must lift the lock."
            : (REMEDIES[code] ?? "Reload the page and try again."),
        ),
    problem.wait && !disabled ? waiting(problem.wait) : null,
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
  `This key lacks the right “${right}”, so this is switched off. ` +
  "The operator can make a key that has it: veilface keys create --right " + right;
