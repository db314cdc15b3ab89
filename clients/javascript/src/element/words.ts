/** What `<veilface-login>` says to the person. */

/** The texts of the element. */
export interface Words {
  readonly start: string;
  readonly take: string;
  readonly enroll: string;
  readonly again: string;
  /** While no face was looked for yet. */
  readonly waiting: string;
  /** A face is there that will do. */
  readonly ready: string;
  /** While the photos are taken. */
  readonly hold: string;
  readonly working: string;
  readonly passkey: string;
  readonly accept: string;
  readonly reject: string;
  readonly enrolled: string;
  readonly camera: string;
  /** What a screen reader calls the picture of the camera. */
  readonly video: string;
  /** Follows the message where too many attempts have failed. */
  readonly locked: string;
  /** The service asks for liveness, and the page for none. */
  readonly liveness: string;
  /** What to do before the camera, by what keeps the face from being good enough. */
  readonly hints: Readonly<Record<string, string>>;
  /** By an error's `code`; the error's message for all others. */
  readonly errors: Readonly<Record<string, string>>;
}

/** The texts in English; give others for another language. */
export const WORDS: Words = {
  start: "Start camera",
  take: "Log in",
  enroll: "Enroll",
  again: "Try again",
  waiting: "Look into the camera.",
  ready: "Good. Hold still.",
  hold: "Hold still …",
  working: "One moment …",
  passkey: "Use your passkey.",
  accept: "Welcome.",
  reject: "Not recognised. Try again.",
  enrolled: "You are enrolled.",
  camera: "The camera cannot be used.",
  video: "Your camera",
  locked: "An administrator can lift the lock.",
  liveness: "This service checks that a face is live, which takes photos. This page sends none.",
  hints: {
    no_face: "Bring your face into the outline.",
    multiple_faces: "Come closer: there are several faces.",
    face_too_small: "Come closer.",
    score: "Show your whole face.",
    blur: "Hold still.",
    darkness: "Find more light.",
    brightness: "Find softer light.",
    turned: "Hold the camera upright.",
    pose: "Look straight into the camera.",
    hidden: "Show your whole face.",
  },
  errors: {},
};

/** Words with what is missing in English. */
export const withDefaults = (given: Partial<Words>): Words => ({
  ...WORDS,
  ...given,
  hints: { ...WORDS.hints, ...given.hints },
});
