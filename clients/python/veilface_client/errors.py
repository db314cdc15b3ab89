"""What can go wrong, as one tree.

::

    VeilfaceError
    ├── ServiceError            the service answered with an error: .code, .status, .details …
    │   ├── PhotoRefused        a better photo heals it: no face, several, too small, blurred …
    │   ├── Unauthorized        the API key or token
    │   ├── Forbidden           a right that the API key lacks
    │   ├── NotEnrolled
    │   ├── ContractMismatch
    │   ├── EnrollmentConflict
    │   ├── LockedOut           wait .retry_after, and offer another factor
    │   ├── RateLimited
    │   └── Unavailable         no pack, no database, or too much to do
    ├── ConnectionFailed        no answer: .sent says whether the request may have been done
    ├── UnexpectedAnswer        an answer that is not the service's
    └── LiftFailed              no template was made on this machine

All other codes are plain `ServiceError`s, or have the class of their status. No error repeats the
API key, a photo, or a template.
"""

from typing import TYPE_CHECKING, Any

import httpx
from pydantic import BaseModel, ValidationError

if TYPE_CHECKING:
    from veilface_client.results import Lift


class VeilfaceError(Exception):
    """Every error of this package.

    Attributes
    ----------
    message
        For people; it may change.
    lift
        What a private client had lifted when it failed, and what to repeat the call with in the
        place of the photos: the service may have it. None where there is none, or where it does
        not fit the service's contract.
    """

    lift: "Lift | None" = None

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


class ServiceError(VeilfaceError):
    """The service answered with an error.

    Attributes
    ----------
    code
        For programs: one of the service's error codes; ``http_<status>`` where the answer has none,
        because a proxy gave it.
    status
        The HTTP status.
    details
        What the service adds, by code.
    request_id
        Names the log line of the request.
    retry_after
        Seconds to wait, where the service says so.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        status: int,
        details: dict[str, Any],
        request_id: str | None,
        retry_after: float | None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.status = status
        self.details = details
        self.request_id = request_id
        self.retry_after = retry_after

    def __str__(self) -> str:
        request = "" if self.request_id is None else f", request {self.request_id}"
        return f"{self.message} ({self.code}{request})"


class PhotoRefused(ServiceError):
    """A photo does not serve; ``details["image"]`` is its position in an enrollment."""


class Unauthorized(ServiceError):
    """The API key or token is unknown, revoked or used."""


class Forbidden(ServiceError):
    """The API key lacks a right: ``details["missing"]``."""


class NotEnrolled(ServiceError):
    """Nobody is enrolled under this id."""


class ContractMismatch(ServiceError):
    """A template of another contract."""


class EnrollmentConflict(ServiceError):
    """The subject has another template than may be replaced; ``details["template_id"]`` is it."""


class LockedOut(ServiceError):
    """Too many failed attempts on the subject; ``details["disabled"]``: an operator must act."""


class RateLimited(ServiceError):
    """Too many requests with this API key or from this address."""


class Unavailable(ServiceError):
    """The service cannot do it now."""


class ConnectionFailed(VeilfaceError):
    """No answer arrived; where ``sent`` is true, the service may have done what was asked."""

    def __init__(self, message: str, *, sent: bool) -> None:
        super().__init__(message)
        self.sent = sent


class UnexpectedAnswer(VeilfaceError):
    """The answer is not what the service would say."""


class LiftFailed(VeilfaceError):
    """No template was made: ``message`` says which photo, pack, contract or decoys do not serve."""


_PHOTO_CODES = (
    "no_face",
    "multiple_faces",
    "face_too_small",
    "low_quality",
    "inconsistent_images",
    "unsupported_image",
    "image_too_large",
)
_BY_CODE: dict[str, type[ServiceError]] = {
    "not_enrolled": NotEnrolled,
    "contract_mismatch": ContractMismatch,
    "enrollment_conflict": EnrollmentConflict,
    **dict.fromkeys(_PHOTO_CODES, PhotoRefused),
}
_BY_STATUS: dict[int, type[ServiceError]] = {
    401: Unauthorized,
    403: Forbidden,
    423: LockedOut,
    429: RateLimited,
    502: Unavailable,
    503: Unavailable,
    504: Unavailable,
}


class _Error(BaseModel):
    code: str
    message: str
    details: dict[str, Any] = {}


class _ErrorAnswer(BaseModel):
    error: _Error
    request_id: str | None = None


def error_of(response: httpx.Response) -> VeilfaceError:
    """Return the exception of an answer that is no success."""
    status = response.status_code
    if status < 400:
        return UnexpectedAnswer(f"the service never answers HTTP {status}; is the URL right?")
    try:
        answer = _ErrorAnswer.model_validate_json(response.content)
    except ValidationError:
        # A proxy's page may repeat the request's headers: nothing of it is passed on.
        message = f"HTTP {status}, without an error of the service"
        answer = _ErrorAnswer(error=_Error(code=f"http_{status}", message=message))
    error = answer.error
    header = response.headers.get("Retry-After", "")
    kind = _BY_CODE.get(error.code) or _BY_STATUS.get(status, ServiceError)
    return kind(
        **dict(error),
        status=status,
        request_id=answer.request_id,
        retry_after=float(header) if header.isascii() and header.isdigit() else None,
    )
