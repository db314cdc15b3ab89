/** What the service answers: its JSON as it comes, with the names of docs/rest.md. */

/** What every answer has. */
export interface Answer {
  readonly request_id: string;
  readonly notice?: string;
}

/** The subject is enrolled; `images` is empty for a template. */
export interface Enrollment extends Answer {
  readonly template_id: string;
  readonly contract_id: string;
  readonly replaced: boolean;
  readonly holder_key: boolean;
  readonly images: readonly { index: number; status: string; quality: Record<string, number | null> }[];
}

/**
 * Whether the probe shows the subject.
 *
 * An object is always true in JavaScript: ask for `accepted`, never for the decision itself.
 */
export interface Decision extends Answer {
  readonly accepted: boolean;
  readonly decision: "accept" | "reject";
  readonly reason: string;
  readonly level: string;
  readonly fmr: number | null;
  readonly contract_id: string;
  readonly calibration_id: string;
  readonly distance?: number;
  readonly liveness?: "passed" | "failed" | "not_checked";
  readonly liveness_failure?: string;
  /** What to change in another photo. */
  readonly advice?: string;
}

/** Movements to make, in their order, as the person sees them who makes them. */
export interface Challenge extends Answer {
  readonly challenge_id: string;
  readonly movements: readonly string[];
  readonly min_frames: number;
  readonly max_frames: number;
  readonly expires_at: string;
}

/** A token for one call of one subject, which a browser may hold (docs/rest.md "Tokens"). */
export interface Token extends Answer {
  /** For the page. Not printed. */
  readonly token: string;
  /** For the session of your server, which asks by it what came of the token. */
  readonly token_id: string;
  readonly subject_id: string;
  readonly action: "verify" | "enroll";
  readonly level: string | null;
  readonly expires_at: string;
}

/** What came of a token. */
export interface TokenOutcome extends Answer {
  readonly token_id: string;
  readonly used: boolean;
  readonly outcome: string | null;
  readonly level: string | null;
  readonly used_at: string | null;
}

/** A subject, without its template. */
export interface Subject {
  readonly subject_id: string;
  readonly template_id: string;
  readonly contract_id: string;
  readonly current: boolean;
  readonly enrolled_by: string;
  readonly photos: number;
  readonly holder_key: boolean;
  readonly created_at: string;
  readonly updated_at: string;
}

/** One page of subjects, in the order of their ids; no cursor on the last one. */
export interface SubjectPage extends Answer {
  readonly subjects: readonly Subject[];
  readonly next_cursor: string | null;
}

/** The signed receipt of an erasure. `claims` is for reading; `receipt` is what is signed. */
export interface Receipt extends Answer {
  readonly receipt: { readonly body: string; readonly signature: string };
  readonly claims: Readonly<Record<string, unknown>>;
  /** False where SQLite's log still holds old pages, which a later purge removes. */
  readonly log_purged: boolean;
}

/** The contract's graphs, where the service serves them. */
export interface PackList extends Answer {
  readonly name: string;
  readonly licence: string | null;
  readonly contract_id: string;
  readonly files: readonly {
    readonly role: "detector" | "embedder";
    readonly sha256: string;
    readonly bytes: number;
  }[];
}
