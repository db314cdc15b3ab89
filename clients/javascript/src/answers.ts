/** What the service answers: its JSON as it comes, by the types of its OpenAPI document. */

import type { components } from "./openapi.js";

type Schemas = components["schemas"];

/** What every answer has. */
export type Answer = Pick<Schemas["HealthAnswer"], "request_id">;
/** The subject is enrolled; `images` is empty for a template. */
export type Enrollment = Schemas["EnrollmentAnswer"];
/** Movements to make, in their order, as the person who makes them sees them. */
export type Challenge = Schemas["ChallengeAnswer"];
/** A token for one call of one subject, which a browser may hold (docs/rest.md "Tokens"). */
export type Token = Schemas["TokenAnswer"];
/** What came of a token. */
export type TokenOutcome = Schemas["TokenOutcomeAnswer"];
/** A subject, without its template. */
export type Subject = Schemas["Subject"];
/** One page of subjects, in the order of their ids; no cursor on the last one. */
export type SubjectPage = Schemas["SubjectsAnswer"];
/** The signed receipt of an erasure. `claims` is for reading; `receipt` is what is signed. */
export type Receipt = Schemas["ReceiptAnswer"];
/** The contract's graphs, where the service serves them. */
export type PackList = Schemas["PackAnswer"];

/**
 * Whether the probe shows the subject.
 *
 * An object is always true in JavaScript: ask for `accepted`, never for the decision itself.
 */
export type Decision = Schemas["VerifyAnswer"] & { readonly accepted: boolean };
