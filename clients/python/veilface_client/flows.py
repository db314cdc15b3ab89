"""What the blocking and the asynchronous client share: everything but the I/O itself.

A flow is a generator. It yields what is to be done, is sent what came of it, and returns the
result::

    Send(call's request) ─▶ httpx.Response, or an httpx error thrown into the flow
    Wait(seconds)        ─▶ None
    Work(function)       ─▶ what it returns; it blocks (files, lifting)

``client.py`` and ``async_client.py`` are its two drivers.
"""

from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import httpx

from veilface_client import calls, results
from veilface_client.calls import Call, Face
from veilface_client.errors import ConnectionFailed, VeilfaceError, error_of
from veilface_client.photos import Photo, read_photos
from veilface_client.retries import Retries

T = TypeVar("T")


@dataclass(frozen=True, repr=False)
class Send:
    """One request."""

    method: str
    path: str
    content: Mapping[str, Any]


@dataclass(frozen=True)
class Wait:
    """A pause before the next sending."""

    seconds: float


@dataclass(frozen=True, repr=False)
class Work:
    """Something that blocks."""

    function: Callable[[], Any]


Flow = Generator[Send | Wait | Work, Any, T]


def send(call: Call[T], retries: Retries) -> Flow[T]:
    """Send a call until it is answered, or ``retries`` says that it is enough."""
    sending = 0
    while True:
        sending += 1
        failure: VeilfaceError
        try:
            response: httpx.Response = yield Send(call.method, call.path, call.content())
        except httpx.RequestError as error:
            failure = _connection_failed(error)
        else:
            if response.is_success:
                return call.read(response)
            failure = error_of(response)
        wait = retries.wait(failure, sending=sending, resend=call.resend)
        if wait is None:
            # Without its cause: the texts of a protocol error may repeat a header.
            raise failure from None
        yield Wait(wait)


_NEVER_MADE = (httpx.ConnectError, httpx.ConnectTimeout, httpx.PoolTimeout)


def _connection_failed(error: httpx.RequestError) -> ConnectionFailed:
    kind = type(error).__name__
    if isinstance(error, _NEVER_MADE):
        said = f": {error}" if str(error) else ""
        return ConnectionFailed(f"the service was not reached ({kind}{said})", sent=False)
    return ConnectionFailed(
        f"no answer arrived ({kind}); the service may have done what was asked", sent=True
    )


def enroll(
    subject: str,
    photos: Photo | Iterable[Photo],
    retries: Retries,
    *,
    attributes: Mapping[str, str] | None,
    face: Face | None,
    holder_key: bytes | None,
    replace: bool | str,
) -> Flow[results.Enrollment]:
    """Enroll by photos."""
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    call = calls.enroll_photos(
        subject,
        pictures,
        attributes=attributes,
        face=face,
        holder_key=holder_key,
        replace=replace,
    )
    return (yield from send(call, retries))


def verify(
    subject: str,
    photos: Photo | Iterable[Photo],
    retries: Retries,
    *,
    level: str | None,
    face: Face | None,
    challenge: results.Challenge | None,
    holder_key: bytes | None,
) -> Flow[results.Decision]:
    """Verify photos of one person, or the frames that answer a challenge."""
    pictures: list[bytes] = yield Work(lambda: read_photos(photos))
    call = calls.verify_photos(
        subject,
        pictures,
        level=level,
        face=face,
        challenge_id=None if challenge is None else challenge.challenge_id,
        holder_key=holder_key,
    )
    return (yield from send(call, retries))
