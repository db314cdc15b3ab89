/** What `<veilface-login>` says to the person. */

/** The texts in English; give others for another language. */
export const WORDS = {
  start: "Start camera",
  take: "Log in",
  enroll: "Enroll",
  again: "Try again",
  /** While no face was looked for yet. */
  waiting: "Look into the camera.",
  /** A face is there that will do. */
  ready: "Good. Hold still.",
  /** While the photos are taken. */
  hold: "Hold still …",
  working: "One moment …",
  passkey: "Use your passkey.",
  accept: "Welcome.",
  reject: "Not recognised. Try again.",
  enrolled: "You are enrolled.",
  camera: "The camera cannot be used.",
  /** What a screen reader calls the picture of the camera. */
  video: "Your camera",
  /** Follows the message where too many attempts have failed. */
  locked: "An administrator can lift the lock.",
  /** The service asks for liveness, and the page for none. */
  liveness: "This service checks that a face is live, which takes photos. This page sends none.",
  /** What to do before the camera, by what keeps the face from being good enough. */
  hints: {
    no_face: "Bring your face into the outline.",
    multiple_faces: "Come closer: there are several faces.",
    face_too_small: "Come closer.",
    inconsistent_images: "Keep others out of the picture.",
    score: "Show your whole face.",
    blur: "Hold still.",
    darkness: "Find more light.",
    brightness: "Find softer light.",
    turned: "Hold the camera upright.",
    pose: "Look straight into the camera.",
    hidden: "Show your whole face.",
  } as Readonly<Record<string, string>>,
  /** By an error's `code`; the error's message for all others. */
  errors: {} as Readonly<Record<string, string>>,
};

/** The texts of the element. */
export type Words = Readonly<typeof WORDS>;

/** Words with what is missing in English. */
export const withDefaults = (given: Partial<Words>): Words => ({
  ...WORDS,
  ...given,
  hints: { ...WORDS.hints, ...given.hints },
});
