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
    └── LiftFailed              no template was made on this machine: .message

All other codes are plain `ServiceError`s, or have the class of their status. No error repeats the
API key, a photo, or a template.
"""

from typing import TYPE_CHECKING, Any

import httpx

if TYPE_CHECKING:
    from veilface_client.results import Lift


class VeilfaceError(Exception):
    """Every error of this package.

    Attributes
    ----------
    lift
        What a private client had lifted when it failed, and what to repeat the call with in the
        place of the photos: the service may have it. None where there is none, or where it does
        not fit the service's contract.
    """

    lift: "Lift | None" = None


class ServiceError(VeilfaceError):
    """The service answered with an error.

    Attributes
    ----------
    code
        For programs: one of the service's error codes; ``http_<status>`` where the answer has none,
        because a proxy gave it.
    status
        The HTTP status.
    message
        For people; it may change.
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
        request = "" if request_id is None else f", request {request_id}"
        super().__init__(f"{message} ({code}{request})")
        self.code = code
        self.status = status
        self.message = message
        self.details = details
        self.request_id = request_id
        self.retry_after = retry_after


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

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


_BY_CODE: dict[str, type[ServiceError]] = {
    "not_enrolled": NotEnrolled,
    "contract_mismatch": ContractMismatch,
    "enrollment_conflict": EnrollmentConflict,
    "unsupported_image": PhotoRefused,
    "image_too_large": PhotoRefused,
    "no_face": PhotoRefused,
    "multiple_faces": PhotoRefused,
    "face_too_small": PhotoRefused,
    "low_quality": PhotoRefused,
    "inconsistent_images": PhotoRefused,
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


def error_class(code: str, status: int) -> type[ServiceError]:
    """Return the class of an error code, or of the status where the code has none of its own."""
    return _BY_CODE.get(code) or _BY_STATUS.get(status, ServiceError)


def error_of(response: httpx.Response) -> VeilfaceError:
    """Return the exception of an answer that is no success."""
    status = response.status_code
    if status < 400:
        return UnexpectedAnswer(f"the service never answers HTTP {status}; is the URL right?")
    header = response.headers.get("Retry-After", "")
    try:
        body = response.json()
        error, request_id = body["error"], body.get("request_id")
        code, message, details = error["code"], error["message"], error.get("details", {})
        if not (isinstance(code, str) and isinstance(message, str) and isinstance(details, dict)):
            raise TypeError
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        # A proxy's page may repeat the request's headers: nothing of it is passed on.
        code, message = f"http_{status}", f"HTTP {status}, without an error of the service"
        details, request_id = {}, None
    return error_class(code, status)(
        code,
        message,
        status=status,
        details=details,
        request_id=request_id if isinstance(request_id, str) else None,
        retry_after=float(header) if header.isascii() and header.isdigit() else None,
    )
