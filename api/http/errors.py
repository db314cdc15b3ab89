"""Every error code of the service, and the one table from exceptions to codes.

An error body has one shape, framework errors included::

    {"error": {"code": "no_face", "message": "…", "details": {…}}, "request_id": "…"}
"""

import json
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from fastapi.exceptions import RequestValidationError
from pydantic_core import to_json
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse

from models.errors import FaceError, ImageError, ModelError, PhotoRejected
from templates.errors import (
    ContractMismatch,
    DecoyError,
    InvalidEmbedding,
    InvalidTemplate,
    LiftingError,
    SealError,
    StoreError,
    Uncalibrated,
    VeilfaceError,
)
from templates.space.agreement import InconsistentImages
from templates.store.identifiers import InvalidIdentifier, UnknownTenant
from templates.store.lockout import LockedOut, Replayed
from templates.store.subjects import EnrollmentConflict
from templates.store.tenants import RetiredRotation


class StartError(VeilfaceError):
    """The program cannot start; the message is the one sentence that an operator reads."""


class ErrorCode(NamedTuple):
    """Status of a code, and what it means."""

    status: int
    meaning: str


ERROR_CODES = {
    "malformed_request": ErrorCode(
        400, "The body does not match its content type, or the request is not well-formed HTTP."
    ),
    "unsupported_image": ErrorCode(400, "The photo cannot be decoded safely."),
    "invalid_template": ErrorCode(
        400, "The template does not follow the format or exceeds its limits."
    ),
    "invalid_embedding": ErrorCode(
        400,
        "The embedding is not a unit vector of n numbers, or has no part along the contract's "
        "axes.",
    ),
    "unauthorized": ErrorCode(401, "The API key or token is missing, unknown or revoked."),
    "replayed": ErrorCode(401, "The challenge or the token was used before, or has expired."),
    "forbidden": ErrorCode(
        403,
        "The API key lacks the right or asks for too low a level, the token is for something "
        "else, the tenant forbids it, or liveness is asked for and the probe cannot show it.",
    ),
    "not_enrolled": ErrorCode(404, "Nobody is enrolled under this id."),
    "not_found": ErrorCode(
        404,
        "There is nothing at this path, or nothing to give: no failed attempts, generator, graph, "
        "challenge or export.",
    ),
    "method_not_allowed": ErrorCode(405, "The path exists, but not with this method."),
    "contract_mismatch": ErrorCode(409, "The template belongs to another contract."),
    "enrollment_conflict": ErrorCode(
        409,
        "The subject has another template than the one that `If-None-Match` or `If-Match` "
        "lets the request replace.",
    ),
    "image_too_large": ErrorCode(413, "The photo is too large, in bytes or pixels."),
    "request_too_large": ErrorCode(413, "The request body is too large."),
    "too_many_images": ErrorCode(413, "The request has too many photos."),
    "no_face": ErrorCode(422, "No face was found in the photo."),
    "multiple_faces": ErrorCode(
        422, "The photo shows several faces, and none is clearly the one that is meant."
    ),
    "face_too_small": ErrorCode(422, "The face is too small in the photo."),
    "low_quality": ErrorCode(
        422, "The photo is turned, blurred or dark, the pose extreme, or part of the face hidden."
    ),
    "inconsistent_images": ErrorCode(422, "The photos do not all show the same person."),
    "uncalibrated": ErrorCode(422, "The contract has no calibration for what was asked."),
    "validation_failed": ErrorCode(422, "A field is missing, unknown, or has a wrong value."),
    "locked_out": ErrorCode(423, "Too many failed attempts for this subject."),
    "rate_limited": ErrorCode(429, "Too many requests with this API key or from this address."),
    "internal_error": ErrorCode(500, "A bug in the service: report the request id."),
    "model_unavailable": ErrorCode(
        503, "The service runs without a model pack, or the model failed on this request."
    ),
    "store_unavailable": ErrorCode(503, "The database does not respond."),
    "overloaded": ErrorCode(503, "Too many requests are waiting, or the worker is stopping."),
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


DISABLED_RETRY_AFTER_S = 86_400
"""What a client is told of a subject that waits for an operator: to ask again in a day."""


def error_answer(error: ApiError, request_id: str) -> JSONResponse:
    """Return an error in the one shape."""
    body = {"code": error.code, "message": error.message, "details": dict(error.details)}
    return JSONResponse(
        {"error": body, "request_id": request_id}, error.status, headers=dict(error.headers)
    )


def api_error(error: Exception) -> ApiError:
    """Give an exception its code: ``internal_error`` for one that nobody expects.

    The text of a client's mistake is passed on: it holds no number of an embedding or template, and
    no key. The text of a failure of the service is not, because it may name a file or a host.
    """
    if isinstance(error, ApiError):
        return error
    if isinstance(error, RequestValidationError):
        problem = error.errors()[0]
        return wrong_value(problem, str(problem["loc"][-1]))
    if isinstance(error, HTTPException):
        code, message = _FRAMEWORK.get(error.status_code, _FRAMEWORK[400])
        return ApiError(code, message, {}, error.headers or {})
    if isinstance(error, PhotoRejected):
        known = api_error(error.cause)
        details = {"image": error.index, **known.details}
        return ApiError(known.code, error.placed(known.message), details, known.headers)
    if isinstance(error, InconsistentImages):
        return ApiError("inconsistent_images", str(error), {"photos": list(error.photos)})
    if isinstance(error, ImageError | FaceError):
        details = plain_details(getattr(error, "details", {}))
        return ApiError(error.code, str(error), details)
    if isinstance(error, LockedOut):
        return _locked_out(error)
    if isinstance(error, EnrollmentConflict):
        return ApiError("enrollment_conflict", str(error), {"template_id": error.template_id})
    for kind, code, public in _TABLE:
        if isinstance(error, kind):
            wait = {"Retry-After": "5"} if ERROR_CODES[code].status == 503 else {}
            return ApiError(code, public or str(error), {}, wait)
    return ApiError("internal_error", "the service failed; report the request id")


def _locked_out(error: LockedOut) -> ApiError:
    disabled = error.retry_after_s is None
    wait = DISABLED_RETRY_AFTER_S if disabled else max(1, math.ceil(error.retry_after_s or 0))
    return ApiError("locked_out", str(error), {"disabled": disabled}, {"Retry-After": str(wait)})


_FRAMEWORK = {
    400: ("malformed_request", "the request cannot be understood"),
    404: ("not_found", "there is no such path"),
    405: ("method_not_allowed", "this path does not take this method"),
    413: ("request_too_large", "the request body is too large"),
}
_TABLE: tuple[tuple[type[Exception], str, str | None], ...] = (
    (ModelError, "model_unavailable", "the model failed on this request"),
    (InvalidTemplate, "invalid_template", None),
    (InvalidEmbedding, "invalid_embedding", None),
    (LiftingError, "validation_failed", None),
    (DecoyError, "validation_failed", None),
    (ContractMismatch, "contract_mismatch", None),
    (Uncalibrated, "uncalibrated", None),
    (SealError, "store_unavailable", "the stored data cannot be opened with the master key"),
    (InvalidIdentifier, "validation_failed", None),
    (Replayed, "replayed", None),
    (RetiredRotation, "store_unavailable", "the tenant's rotation is being renewed; send it again"),
    # The key was good a moment ago: its tenant was erased meanwhile.
    (UnknownTenant, "unauthorized", "the tenant of this API key no longer exists"),
    (StoreError, "store_unavailable", "the database does not respond"),
)


_WORDS = {
    "ge": "must be at least {}",
    "le": "must be at most {}",
    "min_length": "must have a length of at least {}",
    "max_length": "must have a length of at most {}",
    "expected": "must be {}",
}


def wrong_value(problem: Mapping[str, Any], name: str | None, remedy: str = "") -> ApiError:
    """Name the parameter or field that pydantic refused, and its bounds; never what was sent."""
    bounds = problem.get("ctx", {})
    said = [words.format(bounds[bound]) for bound, words in _WORDS.items() if bound in bounds]
    if problem["type"] == "value_error":
        said = [str(bounds["error"])]
    elif problem["type"] == "missing":
        said = ["must be there"]
    said = said or [f"has a wrong value ({problem['type'].replace('_', ' ')})"]
    message = " ".join(filter(None, (name, " and ".join(said)))) + remedy
    return ApiError("validation_failed", message, {} if name is None else {"field": name})


def refuse_unknown_names(
    sent: Iterable[str], known: Collection[str], what: str, remedy: str = ""
) -> None:
    """Refuse query parameters, form fields and JSON keys that a call does not read.

    A misspelt `level` must not pass as the default. The refusal lists the known names.
    """
    if not set(sent) <= set(known):
        raise ApiError(
            "validation_failed",
            f"unknown {what}; known are: {', '.join(sorted(known)) or 'none'}{remedy}",
            {"known": sorted(known)},
        )


def plain_details(details: Mapping[str, Any]) -> dict[str, Any]:
    """Return details as JSON values: NumPy's numbers as Python's, null for one that is not one."""
    plain: dict[str, Any] = json.loads(to_json(details, inf_nan_mode="null", fallback=float))
    return plain
