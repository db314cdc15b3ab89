"""What can go wrong, as one tree.

::

    VeilfaceError
    ├── ServiceError            the service answered with an error: .code, .status, .details …
    │   ├── InvalidRequest      the request itself: malformed, unknown field, too large
    │   ├── PhotoRefused        a better photo heals it: no face, several, too small, blurred …
    │   ├── Unauthorized        the API key or token
    │   ├── Forbidden           a right that the API key lacks
    │   ├── NotFound
    │   │   └── NotEnrolled
    │   ├── Conflict
    │   │   ├── ContractMismatch
    │   │   ├── EnrollmentConflict
    │   ├── LockedOut           wait .retry_after, and offer another factor
    │   ├── RateLimited
    │   └── ServerFailed        a defect of the service
    │       └── Unavailable     no pack, no database, or too much to do
    ├── ConnectionFailed        no answer: .sent says whether the request may have been done
    ├── UnexpectedAnswer        an answer that is not the service's
    └── LiftFailed              no template was made on this machine: .message
        └── LiftUnavailable     what makes it is not installed

A code that this version does not know gives the class of its status. No error repeats the API key,
a photo, or a template.
"""

from collections.abc import Mapping
from typing import Any

import httpx

from veilface_client.lifts import Enrollable, Probe


class VeilfaceError(Exception):
    """Every error of this package.

    Attributes
    ----------
    lift
        What a private client had lifted when it failed, and what to repeat the call with in the
        place of the photos: the service may have it. None where there is none, or where it does
        not fit the service's contract.
    """

    lift: Enrollable | Probe | None = None


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
        details: Mapping[str, Any] | None = None,
        request_id: str | None = None,
        retry_after: float | None = None,
    ) -> None:
        named = code if request_id is None else f"{code}, request {request_id}"
        super().__init__(f"{message} ({named})")
        self.code = code
        self.status = status
        self.message = message
        self.details: dict[str, Any] = dict(details or {})
        self.request_id = request_id
        self.retry_after = retry_after


class InvalidRequest(ServiceError):
    """The request is wrong, and will be every time."""


class PhotoRefused(ServiceError):
    """A photo does not serve; ``details["image"]`` is its position in an enrollment."""


class Unauthorized(ServiceError):
    """The API key or token is unknown, revoked or used."""


class Forbidden(ServiceError):
    """The API key lacks a right: ``details["missing"]``."""


class NotFound(ServiceError):
    """There is nothing to return."""


class NotEnrolled(NotFound):
    """Nobody is enrolled under this id."""


class Conflict(ServiceError):
    """What the request builds on is not so."""


class ContractMismatch(Conflict):
    """A template of another contract."""


class EnrollmentConflict(Conflict):
    """The subject has another template than may be replaced; ``details["template_id"]`` is it."""


class LockedOut(ServiceError):
    """Too many failed attempts on the subject; ``details["disabled"]``: an operator must act."""


class RateLimited(ServiceError):
    """Too many requests with this API key or from this address."""


class ServerFailed(ServiceError):
    """The service failed."""


class Unavailable(ServerFailed):
    """The service cannot do it now."""


class ConnectionFailed(VeilfaceError):
    """No answer arrived.

    Attributes
    ----------
    sent
        False if the connection was never made: the service has not seen the request. True if it may
        have done what was asked.
    """

    def __init__(self, message: str, *, sent: bool) -> None:
        super().__init__(message)
        self.sent = sent


class UnexpectedAnswer(VeilfaceError):
    """The answer is not what the service would say."""


class LiftFailed(VeilfaceError):
    """No template was made: photos, pack, contract or decoys do not serve.

    Attributes
    ----------
    message
        What is wrong, and the remedy.
    """

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.message = message


class LiftUnavailable(LiftFailed):
    """The package ``veilface`` is not installed, or cannot be imported in this process."""


FAMILIES: dict[str, type[ServiceError]] = {
    "malformed_request": InvalidRequest,
    "unsupported_image": PhotoRefused,
    "invalid_template": InvalidRequest,
    "invalid_embedding": InvalidRequest,
    "unauthorized": Unauthorized,
    "replayed": Unauthorized,
    "forbidden": Forbidden,
    "not_enrolled": NotEnrolled,
    "not_found": NotFound,
    "method_not_allowed": InvalidRequest,
    "contract_mismatch": ContractMismatch,
    "enrollment_conflict": EnrollmentConflict,
    "image_too_large": PhotoRefused,
    "request_too_large": InvalidRequest,
    "too_many_images": InvalidRequest,
    "no_face": PhotoRefused,
    "multiple_faces": PhotoRefused,
    "face_too_small": PhotoRefused,
    "low_quality": PhotoRefused,
    "inconsistent_images": PhotoRefused,
    "uncalibrated": InvalidRequest,
    "validation_failed": InvalidRequest,
    "locked_out": LockedOut,
    "rate_limited": RateLimited,
    "internal_error": ServerFailed,
    "model_unavailable": Unavailable,
    "store_unavailable": Unavailable,
    "overloaded": Unavailable,
}
"""Every error code of the service, with its class."""

_BY_STATUS: dict[int, type[ServiceError]] = {
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    423: LockedOut,
    429: RateLimited,
    502: Unavailable,
    503: Unavailable,
    504: Unavailable,
}


def error_of(response: httpx.Response) -> VeilfaceError:
    """Give an answer that is no success its exception."""
    status = response.status_code
    if status < 400:
        return UnexpectedAnswer(f"the service never answers HTTP {status}; is the URL right?")
    fallback = _BY_STATUS.get(status, InvalidRequest if status < 500 else ServerFailed)
    header = response.headers.get("Retry-After", "")
    retry_after = float(header) if header.isascii() and header.isdigit() else None
    try:
        body = response.json()
        code, message = body["error"]["code"], body["error"]["message"]
        details, request_id = body["error"].get("details", {}), body.get("request_id")
        if not (isinstance(code, str) and isinstance(message, str) and isinstance(details, dict)):
            raise TypeError
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        # A proxy's page may repeat the request's headers: nothing of it is passed on.
        said = f"HTTP {status}, without an error of the service"
        return fallback(f"http_{status}", said, status=status, retry_after=retry_after)
    return FAMILIES.get(code, fallback)(
        code,
        message,
        status=status,
        details=details,
        request_id=request_id if isinstance(request_id, str) else None,
        retry_after=retry_after,
    )
