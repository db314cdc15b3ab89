"""Every call of the service, written once: what is sent, what comes back, when it is sent again.

The calls are coroutines over a :class:`Channel`. On asyncio they are the client; a blocking client
runs them over a channel that never suspends them, so that each ends at its first step.
"""

import base64
import json
import random
import secrets
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import quote

import httpx

from veilface_client import results
from veilface_client.errors import (
    ConnectionFailed,
    ContractMismatch,
    RateLimited,
    Unavailable,
    UnexpectedAnswer,
    VeilfaceError,
    error_of,
)
from veilface_client.lifting import Lifter
from veilface_client.photos import Photo, read_photos

V = TypeVar("V", bound=results.Value)
L = TypeVar("L", bound=results.Lift)
Photos = Photo | Iterable[Photo]
Face = Literal["dominant", "largest", "single"]
Action = Literal["verify", "enroll"]

HOLDER_KEY_BYTES = 32


@dataclass(frozen=True)
class Channel:
    """How requests travel (as by httpx), how a client pauses, and how it calls what blocks."""

    request: Callable[..., Awaitable[httpx.Response]]
    sleep: Callable[[float], Awaitable[None]]
    run: Callable[..., Awaitable[Any]]


@dataclass(frozen=True)
class Retries:
    """How often a call is sent, and how long the client waits in between.

    Attributes
    ----------
    sendings
        The most times that one call is sent; 1 never sends again.
    patience_s
        The longest wait. A ``Retry-After`` above it raises the error at once. The client waits as
        long as that says and, with or without it, a random time that doubles from 0.25 s on.
    """

    sendings: int = 4
    patience_s: float = 30.0

    def wait(self, error: VeilfaceError, *, sending: int, repeatable: bool) -> float | None:
        """Return the seconds to wait after the n-th `sending`; None: raise the error.

        A `repeatable` call may be sent again although the service may have done it.
        """
        asked = float(getattr(error, "retry_after", None) or 0)
        if sending >= self.sendings or asked > self.patience_s or not _heals(error, repeatable):
            return None
        return asked + random.uniform(0, min(self.patience_s, 0.125 * 2**sending))


def _heals(error: VeilfaceError, repeatable: bool) -> bool:
    if isinstance(error, ConnectionFailed):
        return repeatable or not error.sent
    if isinstance(error, Unavailable):
        return error.code == "overloaded" or (repeatable and error.code != "model_unavailable")
    return isinstance(error, RateLimited)


def new_holder_key() -> bytes:
    """Make a key for one enrollment, which only the person or their device should hold."""
    return secrets.token_bytes(HOLDER_KEY_BYTES)


class Calls:
    """The calls that carry no face."""

    def __init__(self, channel: Channel, retries: Retries | None) -> None:
        self._channel = channel
        self._retries = retries or Retries()

    async def page(self, *, limit: int = 100, cursor: str | None = None) -> results.SubjectPage:
        """List one page of subjects. Right: ``enroll``."""
        params = _present(limit=limit, cursor=cursor)
        return await self._send(results.SubjectPage, "GET", "/v1/subjects", params=params)

    async def subjects(self, *, page_size: int = 100) -> AsyncIterator[results.Subject]:
        """Iterate over all subjects, in the order of their ids, a page at a time."""
        page = await self.page(limit=page_size)
        while True:
            for subject in page.subjects:
                yield subject
            if page.next_cursor is None:
                return
            page = await self.page(limit=page_size, cursor=page.next_cursor)

    async def describe(self, subject: str) -> results.Subject:
        """Describe a subject, without its template. Right: ``enroll``."""
        return await self._send(results.Subject, "GET", _path(subject))

    async def erase(self, subject: str) -> results.Receipt:
        """Erase a subject, for good; keep the receipt. Right: ``erase``."""
        return await self._send(results.Receipt, "DELETE", _path(subject))

    async def lockout(self, subject: str) -> results.Lockout:
        """Count the failed attempts; ``not_found`` where there are none. Right: ``admin``."""
        return await self._send(results.Lockout, "GET", _path(subject, "/lockout"))

    async def reset_lockout(self, subject: str) -> results.Unlocked:
        """Forget the failed attempts, and enable the subject again. Right: ``admin``."""
        return await self._send(results.Unlocked, "DELETE", _path(subject, "/lockout"))

    async def contract(self) -> results.Contract:
        """Fetch the contract in force, with the key of receipts."""
        return await self._send(results.Contract, "GET", "/v1/contract")

    async def generator(self) -> results.Generator:
        """Fetch the decoy generator. Right: ``embeddings``."""
        return await self._send(results.Generator, "GET", "/v1/contract/generator")

    async def export(self, subject: str) -> results.Export:
        """Export a subject, encrypted. Right: ``export``."""
        return await self._send(results.Export, "GET", _path(subject, "/export"))

    async def import_(self, exported: str | results.Export) -> results.Imported:
        """Import what :meth:`export` returned. Rights: ``export`` and ``admin``."""
        body = {"export": exported.export if isinstance(exported, results.Export) else exported}
        return await self._send(results.Imported, "POST", "/v1/subjects/import", json=body)

    async def create_token(
        self,
        subject: str,
        action: Action,
        *,
        level: str | None = None,
        lifetime_s: int | None = None,
        replace: bool = True,
    ) -> results.Token:
        """Ask for a token for a browser. Right: ``verify`` or ``enroll``, as the action.

        With `replace` False its enrollment replaces nobody, as :meth:`enroll` with the same.
        """
        body = _present(level=level, lifetime_s=lifetime_s, replace=None if replace else False)
        body |= {"subject_id": subject, "action": action}
        return await self._send(results.Token, "POST", "/v1/tokens", json=body)

    async def token_outcome(self, subject: str, token_id: str) -> results.TokenOutcome:
        """Ask what came of a token that this key asked for: never believe the page."""
        path = _path(subject, f"/tokens/{quote(token_id, safe='')}")
        return await self._send(results.TokenOutcome, "GET", path)

    async def ready(self) -> results.Health:
        """Ask once whether the service can answer; otherwise :class:`Unavailable`."""
        once = Retries(sendings=1)
        return await self._send(results.Health, "GET", "/health/ready", retries=once)

    async def _enroll(
        self, subject: str, replace: bool | str, **content: Any
    ) -> results.Enrollment:
        headers = {}
        if replace is False:
            headers["If-None-Match"] = "*"
        elif replace is not True:
            headers["If-Match"] = f'"{replace}"'
        return await self._send(
            results.Enrollment,
            "PUT",
            _path(subject, "/enrollment"),
            # One that may replace only something would meet what its own first sending wrote.
            repeatable=replace is True,
            headers=headers,
            **content,
        )

    async def _verify(self, subject: str, **content: Any) -> results.Decision:
        # One whose answer was lost may have been decided, and a rejection counts.
        path = _path(subject, "/verify")
        return await self._send(results.Decision, "POST", path, repeatable=False, **content)

    async def _send(
        self,
        result: type[V],
        method: str,
        path: str,
        *,
        repeatable: bool = True,
        retries: Retries | None = None,
        **content: Any,
    ) -> V:
        """Send a request until it is answered, or the retries say that it is enough."""
        for sending in count(1):
            failure: VeilfaceError
            try:
                response = await self._channel.request(method, path, **content)
            except httpx.RequestError as error:
                failure = _connection_failed(error)
            else:
                if response.is_success:
                    return result.read(response)
                failure = error_of(response)
            wait = (retries or self._retries).wait(failure, sending=sending, repeatable=repeatable)
            if wait is None:
                # Without its cause: the texts of a protocol error may repeat a header.
                raise failure from None
            await self._channel.sleep(wait)
        raise AssertionError  # the count has no end


class PhotoCalls(Calls):
    """The calls of a client that sends photos."""

    async def enroll(
        self,
        subject: str,
        photos: Photos,
        *,
        attributes: Mapping[str, str] | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> results.Enrollment:
        """Enroll a subject, or replace its enrollment. Right: ``enroll``.

        Parameters
        ----------
        photos
            1 to 10 of one person: bytes, paths or binary files.
        attributes
            ``gender`` and ``race``, for services that lift with hybrid+; never stored.
        face
            Of several faces, ``dominant`` (the service's default) takes the largest if it covers
            the middle and has twice the area of every other; ``largest`` takes the largest wherever
            it is; ``single`` refuses the photo.
        holder_key
            32 bytes (:func:`new_holder_key`) without which the enrollment accepts nobody, and which
            the service does not keep. Without it the person must enroll again.
        replace
            What may be replaced: whatever there is, nothing (False), or the enrollment of this
            ``template_id`` only; otherwise :class:`EnrollmentConflict`. A lost answer is then not
            asked for again: look with :meth:`describe` what is enrolled.
        """
        fields = _present(
            attributes=None if attributes is None else json.dumps(dict(attributes)),
            face=face,
            holder_key=_encoded(holder_key),
        )
        files = await self._files("images", photos)
        return await self._enroll(subject, replace, files=files, data=fields)

    async def challenge(self, subject: str | None = None) -> results.Challenge:
        """Ask for a challenge of head movements, for one verification. Right: ``verify``.

        With a subject, it can be answered for that one only.
        """
        body = _present(subject_id=subject)
        return await self._send(results.Challenge, "POST", "/v1/challenges", json=body)

    async def verify(
        self,
        subject: str,
        photos: Photos,
        *,
        level: str | None = None,
        face: Face | None = None,
        challenge: results.Challenge | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Check whether 1 to 5 photos of one person show the subject. Right: ``verify``.

        A rejection is no error: the decision is false. Each rejection counts once on the subject's
        lockout, however many photos there were. An enrollment that was made with a
        ``holder_key`` rejects every call without it; any other ignores it.

        Parameters
        ----------
        challenge
            One of :meth:`challenge`: the photos are then the frames that answer it, in their
            order, as the camera gives them, not mirrored.
        """
        fields = _present(
            level=level,
            face=face,
            challenge_id=None if challenge is None else challenge.challenge_id,
            holder_key=_encoded(holder_key),
        )
        files = await self._files("image", photos)
        return await self._verify(subject, files=files, data=fields)

    async def compare(
        self, first: Photo, second: Photo, *, level: str | None = None, face: Face | None = None
    ) -> results.Decision:
        """Check whether two photos show one person; nothing is stored. Right: ``verify``.

        The `first` stands for an enrollment, and the `second` is decided as by :meth:`verify`. No
        attempt is counted on anybody, so a lost answer is asked for again.
        """
        files = await self._files("images", [first, second])
        data = _present(level=level, face=face)
        return await self._send(results.Decision, "POST", "/v1/compare", files=files, data=data)

    async def _files(self, field: str, photos: Photos) -> list[tuple[str, tuple[str, bytes, str]]]:
        pictures = await self._channel.run(read_photos, photos)
        # A file name of the user's machine is nobody else's business.
        return [(field, ("photo", picture, "application/octet-stream")) for picture in pictures]


class PrivateCalls(Calls):
    """The calls of a client that never sends a face: it lifts here, and sends templates."""

    def __init__(
        self, channel: Channel, retries: Retries | None, *, pack: Path, dim: int | None
    ) -> None:
        super().__init__(channel, retries)
        self._pack = pack
        self._dim = dim
        self._lifter: Lifter | None = None

    async def enroll(
        self,
        subject: str,
        photos: Photos | results.Enrollable,
        *,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> results.Enrollment:
        """Lift photos here (or take a lift of :meth:`lift_enrollment`), and enroll by it alone.

        Rights: ``enroll``, ``embeddings``. Never enroll the same photos twice: two lifts of them
        give the embedding away. After an error repeat with its ``lift``.
        """
        fields = _present(holder_key=_encoded(holder_key))
        if not isinstance(photos, results.Enrollable):
            photos = await self.lift_enrollment(photos, face=face)
        with self._sending(photos):
            return await self._enroll(subject, replace, json=_template(photos) | fields)

    async def verify(
        self,
        subject: str,
        photos: Photos | results.Probe,
        *,
        level: str | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Lift photos of one person here (or take a probe of :meth:`lift`), and verify by it.

        Rights: ``verify``, ``embeddings``. After an error repeat with its ``lift``, never with the
        photos.
        """
        fields = _present(level=level, holder_key=_encoded(holder_key))
        if not isinstance(photos, results.Probe):
            photos = await self.lift(photos, face=face)
        with self._sending(photos):
            return await self._verify(subject, json=_template(photos) | fields)

    async def lift_enrollment(
        self, photos: Photos, *, face: Face | None = None
    ) -> results.Enrollable:
        """Lift photos of one person here, and send nothing of them.

        :meth:`enroll` takes the lift, as often as it must: it is one and the same write.
        """
        return await self._lift(results.Enrollable, photos, face)

    async def lift(self, photos: Photos, *, face: Face | None = None) -> results.Probe:
        """Lift a probe here, of photos of one person; several subjects may be verified by it."""
        return await self._lift(results.Probe, photos, face)

    async def _lift(self, kind: type[L], photos: Photos, face: Face | None) -> L:
        pictures = await self._channel.run(read_photos, photos)
        lifter = self._lifter = self._lifter or await self._load()
        lift: L = await self._channel.run(lifter.lift, kind, pictures, self._dim, face)
        return lift

    async def _load(self) -> Lifter:
        for _ in range(3):
            contract = await self.contract()
            generator = await self.generator()
            # The contract may have changed between the two answers, or between two workers.
            if generator.source_id == contract.binding.get("decoy_source_id"):
                lifter: Lifter = await self._channel.run(
                    Lifter.load, self._pack, contract, generator
                )
                return lifter
        raise UnexpectedAnswer("the generator of the service is not that of its contract")

    @contextmanager
    def _sending(self, lift: results.Lift) -> Iterator[None]:
        """Put a lift into the error that ends its sending, so that callers can repeat it."""
        try:
            yield
        except ContractMismatch:
            # Not lifted again here: a service that only claims to have changed would get two lifts.
            self._lifter = None
            raise
        except VeilfaceError as error:
            error.lift = lift
            error.add_note(
                "The service may have this lift: repeat the call with the error's `lift`, never "
                "with the photo. Two lifts of one photo give the embedding away."
            )
            raise


def _connection_failed(error: httpx.RequestError) -> ConnectionFailed:
    kind = type(error).__name__
    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout):
        cause = f": {error}" if str(error) else ""
        return ConnectionFailed(f"the service was not reached ({kind}{cause})", sent=False)
    return ConnectionFailed(
        f"no answer arrived ({kind}); the service may have done what was asked", sent=True
    )


def _path(subject: str, rest: str = "") -> str:
    """Return the path of a subject; an id that is no segment would lead to another one."""
    if subject in ("", ".", "..") or "/" in subject:
        raise ValueError("a subject id is letters, marks and digits, and . _ @ : -")
    return f"/v1/subjects/{quote(subject, safe='@:')}{rest}"


def _encoded(holder_key: bytes | None) -> str | None:
    if holder_key is None:
        return None
    return base64.urlsafe_b64encode(holder_key).decode("ascii").rstrip("=")


def _template(lift: results.Lift) -> dict[str, str]:
    return {"template": base64.b64encode(lift.template).decode("ascii")}


def _present(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
