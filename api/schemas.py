"""Shapes of the answers and of the JSON requests, for OpenAPI and for the tests.

Routes build plain dictionaries; a test holds every answer against these models.
"""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

HEX = "9f86d081884c7d659a2feaa0c55ad015a3bf4f1b2b0b822cd15d6c15b0f00a08"
REQUEST_ID = "4b1f0d5c8f1e4c54a52b3c9f7e2d6a10"


class _Shape(BaseModel):
    model_config = ConfigDict(extra="forbid")


class _Answer(_Shape):
    request_id: str = Field(description="Also in X-Request-ID.", examples=[REQUEST_ID])
    notice: str | None = Field(None, description="Only with the demo model.")


class ErrorBody(_Shape):
    """What went wrong."""

    code: str = Field(examples=["no_face"])
    message: str = Field(examples=["no face was found in the photo"])
    details: dict[str, Any]


class ErrorAnswer(_Shape):
    """The one shape of all errors."""

    error: ErrorBody
    request_id: str = Field(examples=[REQUEST_ID])


class Photo(_Shape):
    """What was seen in one photo of an enrollment."""

    index: int = Field(description="Position in the request, from 0.")
    status: Literal["used"]
    quality: dict[str, float | None] = Field(description="Measures of the quality gate.")


class EnrollmentAnswer(_Answer):
    """The subject is enrolled."""

    template_id: str = Field(description="Changes with every enrollment.")
    contract_id: str = Field(examples=[HEX])
    replaced: bool = Field(description="An earlier enrollment was replaced.")
    images: list[Photo] = Field(description="One for each photo; empty for a template.")


class TemplateRequest(_Shape):
    """A private template that a client lifted."""

    template: str = Field(description="Base64 of the wire bytes.")


class VerifyRequest(_Shape):
    """A probe that is no photo: exactly one of both."""

    embedding: list[float] | None = Field(None, description="Unit-norm, of the contract's n.")
    template: str | None = Field(None, description="Base64 of a lifted probe's wire bytes.")
    level: str | None = Field(None, description="Security level; default from the contract.")


class VerifyAnswer(_Answer):
    """The decision."""

    decision: Literal["accept", "reject"]
    reason: Literal["match", "no_match"]
    level: str = Field(examples=["fmr-1e-3"])
    fmr: float = Field(description="False match rate of the level.", examples=[0.001])
    contract_id: str = Field(examples=[HEX])
    calibration_id: str = Field(examples=[HEX])
    distance: float | None = Field(None, description="Only for keys with the right `scores`.")


class Subject(_Shape):
    """A subject, without its template."""

    subject_id: str = Field(examples=["alice"])
    template_id: str
    contract_id: str = Field(examples=[HEX])
    current: bool = Field(description="Of the contract in force; otherwise enroll again.")
    enrolled_by: Literal["photos", "template"]
    photos: int = Field(description="Photos that were averaged; 0 for a template.")
    created_at: str = Field(examples=["2026-01-31T12:00:00Z"])
    updated_at: str = Field(examples=["2026-01-31T12:00:00Z"])


class SubjectAnswer(Subject, _Answer):
    """One subject."""


class SubjectsAnswer(_Answer):
    """One page of subjects, in the order of their ids."""

    subjects: list[Subject]
    next_cursor: str | None = Field(description="Send it as `cursor` for the next page.")


class SignedReceipt(_Shape):
    """A text and its signature: keep both."""

    body: str = Field(description="Canonical JSON; exactly this text is signed.")
    signature: str = Field(description="Ed25519 over the UTF-8 bytes of `body`, base64.")


class ErasedItem(_Shape):
    """Records of one kind that the erasure removed."""

    item: Literal["template", "data_key", "metadata", "failed_attempts", "idempotency_records"]
    count: int


class ReceiptClaims(BaseModel):
    """What `body` says, for reading only: it is not signed in this form."""

    model_config = ConfigDict(extra="forbid")

    kind: Literal["veilface-erasure-receipt"]
    version: Literal[1]
    receipt_id: str = Field(description="Random; no two receipts share one.")
    tenant: str
    subject: str = Field(description="Pseudonym: HMAC of the subject id under a secret key.")
    erased_at: str = Field(examples=["2026-01-31T12:00:00.000000+00:00"])
    held: bool = Field(description="False: no template was stored.")
    contract_id: str | None = Field(description="Of the template; null: none was held.")
    erased: list[ErasedItem] = Field(description="Every kind of record, with what was removed.")
    signing_key: str = Field(description="`receipt_key.key_id` of GET /v1/contract.")


class ReceiptAnswer(_Answer):
    """The receipt of an erasure."""

    receipt: SignedReceipt
    claims: ReceiptClaims


class ExportAnswer(_Answer):
    """One subject, encrypted."""

    export: str = Field(description="Base64 of the encrypted export.")
    contract_id: str = Field(examples=[HEX])
    key_id: str = Field(description="Names the export key.")


class ImportRequest(_Shape):
    """What an export call returned."""

    export: str


class ImportAnswer(_Answer):
    """The subject is enrolled."""

    subject_id: str
    template_id: str
    contract_id: str = Field(examples=[HEX])
    replaced: bool


class ReceiptKey(_Shape):
    """The key that receipts are verified with."""

    algorithm: Literal["Ed25519"]
    key_id: str
    public_key: str = Field(description="32 bytes, base64.")


class ContractAnswer(_Answer):
    """The contract in force: everything but its cohort."""

    contract_id: str = Field(examples=[HEX])
    binding: dict[str, Any]
    recorded: dict[str, Any]
    calibrations: list[dict[str, Any]]
    default_level: str
    photo_consistency: float
    template_foot_point_norm: list[float]
    cohort_size: int
    cohort_id: str
    photos: bool = Field(description="The service runs with a model pack.")
    generator: bool = Field(description="GET /v1/contract/generator has a generator to give.")
    receipt_key: ReceiptKey


class HealthAnswer(_Answer):
    """The service answers."""

    status: Literal["ok"]
