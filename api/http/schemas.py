"""What the calls answer: FastAPI writes these models as JSON, and OpenAPI describes them."""

from contextvars import ContextVar
from datetime import UTC, datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer

from api.http.errors import ERROR_CODES
from templates.store.api_keys import Right
from verify import Movement
from verify.challenge import LivenessFailure

REQUEST_ID: ContextVar[str] = ContextVar("request_id")
"""Id of the request that is being answered, which the middleware sets."""
NOTICE: ContextVar[str | None] = ContextVar("notice", default=None)
"""What every answer of the demo says, which the middleware sets too."""


def iso_time(value: datetime) -> str:
    """Write a time in UTC to the second, as ``2026-01-31T12:00:00Z``."""
    return value.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def _absent(description: str) -> Any:
    """A field that the answer lacks where it has no value."""
    return Field(None, description=description, exclude_if=lambda value: value is None)


Time = Annotated[
    datetime,
    PlainSerializer(iso_time, return_type=str),
    Field(examples=["2026-01-31T12:00:00Z"]),
]
"""In UTC, to the second."""


class _Shape(BaseModel):
    model_config = ConfigDict(extra="forbid", json_schema_serialization_defaults_required=True)


class _Answer(_Shape):
    """What every answer has."""

    request_id: str = Field(
        default_factory=lambda: REQUEST_ID.get(), description="Also in X-Request-ID."
    )
    notice: str | None = Field(
        default_factory=lambda: NOTICE.get(),
        description="Only with the demo model.",
        exclude_if=lambda value: value is None,
    )


class ErrorBody(_Shape):
    """What went wrong."""

    code: str = Field(json_schema_extra={"enum": list(ERROR_CODES)})
    message: str
    details: dict[str, Any]


class ErrorAnswer(_Shape):
    """The one shape of all errors."""

    error: ErrorBody
    request_id: str


class Photo(_Shape):
    """What was seen in one photo of an enrollment."""

    index: int = Field(description="Position in the request, from 0.")
    status: Literal["used"]
    quality: dict[str, float | None] = Field(description="Measures of the quality gate.")


class _EnrolledAnswer(_Answer):
    template_id: str = Field(description="Changes with every enrollment.")
    contract_id: str
    replaced: bool = Field(description="An earlier enrollment was replaced.")
    holder_key: bool = Field(description="It accepts nobody without the holder's key.")


class EnrollmentAnswer(_EnrolledAnswer):
    """The subject is enrolled."""

    images: list[Photo] = Field(description="One for each photo; empty for a template.")


class ImportAnswer(_EnrolledAnswer):
    """The subject is enrolled."""

    subject_id: str


class VerifyAnswer(_Answer):
    """The decision."""

    decision: Literal["accept", "reject"]
    reason: Literal["match", "no_match", "liveness"]
    liveness: Literal["passed", "failed", "not_checked"] = Field(
        description="Whether a living person made the probe."
    )
    level: str
    fmr: float = Field(description="False match rate of the level.")
    contract_id: str
    calibration_id: str
    distance: float | None = _absent("Only for keys with `scores` and `enroll`.")
    distance_threshold: float | None = _absent(
        "The largest distance at which this probe is accepted: only beside `distance`."
    )
    liveness_failure: LivenessFailure | None = _absent(
        "Why liveness failed: only for keys with `scores` and `enroll`."
    )
    advice: str | None = _absent(
        "What to change in another photo, after `no_match`: by the photo alone, "
        "whether the subject is enrolled or not."
    )


class ChallengeAnswer(_Answer):
    """Movements to make, and the id that their frames are sent with."""

    challenge_id: str
    movements: list[Movement] = Field(
        description="In this order, as the person sees them who makes them."
    )
    min_frames: int
    max_frames: int
    expires_at: Time


class TokenAnswer(_Answer):
    """A token for one call of one subject."""

    token: str = Field(
        description="For the browser, as `Authorization: Bearer vft_…`. It is shown once."
    )
    token_id: str = Field(description="For your server, to ask what came of it.")
    subject_id: str
    action: Literal["verify", "enroll"]
    level: str | None = Field(
        description="The only level that it verifies at; null for an enrollment."
    )
    expires_at: Time


class TokenOutcomeAnswer(_Answer):
    """What a token was used for."""

    token_id: str
    used: bool = Field(
        description="False, too, for a token that this key did not ask for, or of another subject."
    )
    outcome: Literal["accept", "reject", "locked_out", "created", "replaced"] | None = Field(
        description="Null where it was not used."
    )
    level: str | None = Field(description="Of a verification that used it.")
    used_at: Time | None


class PackFileEntry(_Shape):
    """One graph of the pack."""

    role: Literal["detector", "embedder"]
    kind: str | None = Field(description="Of a detector.")
    file: str
    sha256: str
    bytes: int
    path: str = Field(description="Where it is, on this service.")
    input_size: list[int] = Field(description="Width and height.")


class PackAnswer(_Answer):
    """The graphs that the contract names, for clients that embed."""

    name: str
    licence: str | None = Field(description="What is known of a pack of this name.")
    contract_id: str
    files: list[PackFileEntry]


class Subject(_Shape):
    """A subject, without its template."""

    subject_id: str
    template_id: str
    contract_id: str
    current: bool = Field(description="Served by the contract in force; otherwise enroll again.")
    enrolled_by: Literal["photos", "template"]
    photos: int = Field(description="Photos that were averaged; 0 for a template.")
    holder_key: bool = Field(description="It accepts nobody without the holder's key.")
    created_at: Time
    updated_at: Time


class SubjectAnswer(Subject, _Answer):
    """One subject."""


class SubjectsAnswer(_Answer):
    """One page of subjects, in the order of their ids."""

    subjects: list[Subject]
    next_cursor: str | None = Field(description="Send it as `cursor` for the next page.")


class AuditLine(_Shape):
    """One line of the audit log: who did what to which subject, and with which result."""

    at: Time
    actor: str = Field(description="Of a request, its key.")
    action: str
    subject: str | None = Field(description="Pseudonym of the subject.")
    outcome: str
    detail: str | None
    request_id: str | None


class AuditLogAnswer(_Answer):
    """One page of the tenant's audit log, the latest line first."""

    lines: list[AuditLine]
    next_cursor: str | None = Field(description="Send it as `cursor` for earlier lines.")


class LockoutAnswer(_Answer):
    """Failed verifications of a subject, enrolled or not."""

    consecutive_failures: int = Field(description="Since the last accept, or the last reset.")
    last_failed_at: Time | None
    locked_until: Time | None = Field(description="No attempt is decided before; null: open.")
    disabled_at: Time | None = Field(description="Since when it waits for an operator.")


class UnlockAnswer(_Answer):
    """The lockout is lifted."""

    lifted: bool = Field(description="False: there was nothing to lift.")


class SignedReceipt(_Shape):
    """A text and its signature: keep both."""

    body: str = Field(description="Canonical JSON; exactly this text is signed.")
    signature: str = Field(description="Ed25519 over the UTF-8 bytes of `body`, base64.")


class ReceiptAnswer(_Answer):
    """The receipt of an erasure."""

    receipt: SignedReceipt
    claims: dict[str, Any] = Field(
        description="What `body` says, for reading only: it is not signed in this form."
    )
    log_purged: bool = Field(
        description="False where a reader of SQLite's database keeps old pages in the write-ahead "
        "log just now: they go with a later purge."
    )


class ExportAnswer(_Answer):
    """One subject, encrypted."""

    export: str = Field(description="Base64 of the encrypted export.")
    contract_id: str
    key_id: str = Field(description="Names the export key.")


class ReceiptKey(_Shape):
    """The key that receipts are verified with."""

    algorithm: Literal["Ed25519"]
    key_id: str
    public_key: str = Field(description="32 bytes, base64.")


class ContractAnswer(_Answer):
    """The contract in force: everything but what is sealed."""

    contract_id: str
    binding: dict[str, Any]
    recorded: dict[str, Any]
    calibrations: list[dict[str, Any]]
    default_level: str
    photo_consistency: float
    probe_consistency: float
    template_stranger_similarity: float
    template_foot_point_norm: list[float]
    verdict: dict[str, Any] | None = Field(
        description="How private and how accurate the calibration found it, and, where people were "
        "labelled, the `groups` with their worst; each with a status, `PASS` or `FAIL`; null: not "
        "measured."
    )
    liveness: dict[str, Any] | None = _absent(
        "The liveness threshold with its graphs and error rates (docs/liveness.md); "
        "absent where there is none."
    )
    photos: bool = Field(description="The service runs with a model pack.")
    generator: bool = Field(description="GET /v1/contract/generator has a generator to give.")
    template_enrollment: bool = Field(
        description="The key's tenant takes templates that clients made."
    )
    receipt_key: ReceiptKey


class KeyAnswer(_Answer):
    """The API key of the request, without its secret."""

    prefix: str = Field(description="How lists and logs name the key.")
    tenant: str
    rights: list[Right]
    levels: list[str] = Field(
        description="Security levels that it may ask for; not those below the lowest that the "
        "deployment or the key allows."
    )
    liveness: Literal["off", "passive", "active", "both"] = Field(
        description="What every verification must pass (docs/liveness.md)."
    )
    expires_at: Time | None
    demo: bool = Field(description="The service runs with the demo model.")


class PhotoCheckAnswer(_Answer):
    """Whether a photo would do."""

    usable: bool
    code: Literal["no_face", "multiple_faces", "face_too_small", "low_quality"] | None = Field(
        default=None, description="Why not, as an enrollment would say; null: it would do."
    )
    message: str
    details: dict[str, Any] = Field(default={}, description="As those of the error of this code.")
    box: list[float] | None = Field(
        default=None, description="x1, y1, x2, y2 in pixels of the upright photo, if usable."
    )
    quality: dict[str, float | None] = Field(default={}, description="Measures, if usable.")


class HealthAnswer(_Answer):
    """The service answers."""

    status: Literal["ok"]
