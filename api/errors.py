"""Every error code of the service, and the one table from exceptions to codes.

An error body has one shape, framework errors included::

    {"error": {"code": "no_face", "message": "…", "details": {…}}, "request_id": "…"}
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from templates.errors import VeilfaceError


class StartError(VeilfaceError):
    """The program cannot start; the message is the one sentence that an operator reads."""


@dataclass(frozen=True)
class ErrorCode:
    """One code: its status, what it means, and whether a later release brings it into use."""

    code: str
    status: int
    meaning: str
    reserved: bool = False


ERROR_CODES: dict[str, ErrorCode] = {
    entry.code: entry
    for entry in (
        ErrorCode("malformed_request", 400, "The body is not what its content type says."),
        ErrorCode("unsupported_image", 400, "The photo cannot be decoded, or not safely."),
        ErrorCode("invalid_template", 400, "The template's bytes break the format or its limits."),
        ErrorCode("invalid_embedding", 400, "The embedding is no finite unit vector of n numbers."),
        ErrorCode("unauthorized", 401, "No API key, or one that is unknown or revoked."),
        ErrorCode("replayed", 401, "The signed probe was seen before.", reserved=True),
        ErrorCode("forbidden", 403, "The API key lacks the right that the call needs."),
        ErrorCode("not_enrolled", 404, "The tenant has no such subject."),
        ErrorCode("not_found", 404, "No such path, or nothing to return there."),
        ErrorCode("method_not_allowed", 405, "The path exists, but not with this method."),
        ErrorCode("contract_mismatch", 409, "The template belongs to another contract."),
        ErrorCode(
            "idempotency_conflict",
            409,
            "The Idempotency-Key was used for another request, or its first request still runs.",
        ),
        ErrorCode("image_too_large", 413, "The photo has too many bytes or pixels."),
        ErrorCode("request_too_large", 413, "The request body has too many bytes."),
        ErrorCode("too_many_images", 413, "The enrollment has too many photos."),
        ErrorCode("no_face", 422, "No face was found in the photo."),
        ErrorCode("multiple_faces", 422, "The photo shows several faces."),
        ErrorCode("face_too_small", 422, "The face has too few pixels."),
        ErrorCode(
            "low_quality", 422, "The photo is too blurred, too dark, or the pose too extreme."
        ),
        ErrorCode("inconsistent_images", 422, "The photos do not show one and the same person."),
        ErrorCode("uncalibrated", 422, "The contract has no calibration for what was asked."),
        ErrorCode("validation_failed", 422, "A field is missing, unknown, or has a wrong value."),
        ErrorCode("locked_out", 423, "Too many failed attempts on this subject.", reserved=True),
        ErrorCode("rate_limited", 429, "Too many requests with this API key.", reserved=True),
        ErrorCode("internal_error", 500, "A defect of the service: report the request id."),
        ErrorCode("model_unavailable", 503, "The service runs without a model pack."),
        ErrorCode("store_unavailable", 503, "The database does not answer."),
        ErrorCode("overloaded", 503, "Too many requests wait already."),
    )
}


@dataclass(eq=False)
class ApiError(Exception):
    """An error with its code; the handlers turn it into the answer."""

    code: str
    message: str
    details: Mapping[str, Any] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__(self.message)
        if self.code not in ERROR_CODES:
            raise ValueError(f"unknown error code {self.code}")

    @property
    def status(self) -> int:
        """HTTP status of the code."""
        return ERROR_CODES[self.code].status
