"""Every call of the service, written once: what is sent, what comes back, when it is sent again.

A flow is a generator. It yields what is to be done, is sent what came of it, and returns the
result::

    a Send      ─▶ httpx.Response, or an httpx error thrown into the flow
    seconds     ─▶ None, after a pause
    a function  ─▶ what it returns; it blocks (files, lifting)

``client.py`` drives flows, blocking or on asyncio. Nothing here does I/O.
"""

import base64
import json
import random
import re
import secrets
import unicodedata
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeVar, cast
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
from veilface_client.lifting import Lifter, LiftInputs
from veilface_client.photos import Photo, read_photos

T = TypeVar("T")
V = TypeVar("V", bound=results.Value)
L = TypeVar("L", bound=results.Lift)
Photos = Photo | Iterable[Photo]
Face = Literal["dominant", "largest", "single"]
Action = Literal["verify", "enroll"]

HOLDER_KEY_BYTES = 32


@dataclass(frozen=True, repr=False)
class Send:
    """One request; ``content`` is what httpx builds it of (``json``, ``files``, ``params`` …)."""

    method: str
    path: str
    content: Mapping[str, Any]


Flow = Generator[Send | float | Callable[[], Any], Any, T]


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
    """Make a key for one enrollment. Keep it where only the person, or their device, gets at it."""
    return secrets.token_bytes(HOLDER_KEY_BYTES)


class Flows:
    """The calls that carry no face."""

    def __init__(self, retries: Retries | None) -> None:
        self._retries = retries or Retries()

    def page(self, *, limit: int = 100, cursor: str | None = None) -> Flow[results.SubjectPage]:
        """List one page of subjects. Right: ``enroll``."""
        params = _present(limit=limit, cursor=cursor)
        return self._send(results.SubjectPage, "GET", "/v1/subjects", params=params)

    def describe(self, subject: str) -> Flow[results.SubjectAnswer]:
        """Describe a subject, without its template. Right: ``enroll``."""
        return self._send(results.SubjectAnswer, "GET", _path(subject))

    def erase(self, subject: str) -> Flow[results.Receipt]:
        """Erase a subject, for good; keep the receipt. Right: ``erase``."""
        return self._send(results.Receipt, "DELETE", _path(subject))

    def lockout(self, subject: str) -> Flow[results.Lockout]:
        """Count the failed attempts; ``not_found`` where there are none. Right: ``admin``."""
        return self._send(results.Lockout, "GET", _path(subject, "/lockout"))

    def reset_lockout(self, subject: str) -> Flow[results.Unlocked]:
        """Forget the failed attempts, and enable the subject again. Right: ``admin``."""
        return self._send(results.Unlocked, "DELETE", _path(subject, "/lockout"))

    def contract(self) -> Flow[results.Contract]:
        """Fetch the contract in force, with the key of receipts."""
        return self._send(results.Contract, "GET", "/v1/contract")

    def generator(self) -> Flow[results.Generator]:
        """Fetch the decoy generator. Right: ``embeddings``."""
        return self._send(results.Generator, "GET", "/v1/contract/generator")

    def export(self, subject: str) -> Flow[results.Export]:
        """Export a subject, encrypted. Right: ``export``."""
        return self._send(results.Export, "GET", _path(subject, "/export"))

    def import_(self, exported: str | results.Export) -> Flow[results.Imported]:
        """Import what :meth:`export` returned. Rights: ``export`` and ``admin``."""
        text = exported.export if isinstance(exported, results.Export) else exported
        return self._send(results.Imported, "POST", "/v1/subjects/import", json={"export": text})

    def create_token(
        self,
        subject: str,
        action: Action,
        *,
        level: str | None = None,
        lifetime_s: int | None = None,
        replace: bool = True,
    ) -> Flow[results.Token]:
        """Ask for a token for a browser. Right: ``verify`` or ``enroll``, as the action.

        With `replace` False its enrollment replaces nobody, as :meth:`enroll` with the same.
        """
        _path(subject)
        body = _present(level=level, lifetime_s=lifetime_s, replace=None if replace else False)
        body |= {"subject_id": subject, "action": action}
        return self._send(results.Token, "POST", "/v1/tokens", json=body)

    def token_outcome(self, subject: str, token_id: str) -> Flow[results.TokenOutcome]:
        """Ask what came of a token that this key asked for: never believe the page."""
        path = _path(subject, f"/tokens/{_id(token_id, 'a token_id')}")
        return self._send(results.TokenOutcome, "GET", path)

    def ready(self) -> Flow[results.Health]:
        """Ask once whether the service can answer; otherwise :class:`Unavailable`."""
        once = Retries(sendings=1)
        return self._send(results.Health, "GET", "/health/ready", retries=once)

    def _enroll(
        self, subject: str, replace: bool | str, **content: Any
    ) -> Flow[results.Enrollment]:
        headers = {}
        if replace is False:
            headers["If-None-Match"] = "*"
        elif replace is not True:
            headers["If-Match"] = f'"{_id(replace, "replace is True, False, or")}"'
        # One that may replace only something would meet what its own first sending wrote.
        return self._send(
            results.Enrollment,
            "PUT",
            _path(subject, "/enrollment"),
            repeatable=replace is True,
            headers=headers,
            **content,
        )

    def _verify(self, subject: str, **content: Any) -> Flow[results.Decision]:
        # One whose answer was lost may have been decided, and a rejection counts.
        path = _path(subject, "/verify")
        return self._send(results.Decision, "POST", path, repeatable=False, **content)

    def _send(
        self,
        result: type[V],
        method: str,
        path: str,
        *,
        repeatable: bool = True,
        retries: Retries | None = None,
        **content: Any,
    ) -> Flow[V]:
        """Send a request until it is answered, or the retries say that it is enough."""
        retries = retries or self._retries
        sending = 0
        while True:
            sending += 1
            failure: VeilfaceError
            try:
                response: httpx.Response = yield Send(method, path, content)
            except httpx.RequestError as error:
                failure = _connection_failed(error)
            else:
                if response.is_success:
                    return result.read(response)
                failure = error_of(response)
            wait = retries.wait(failure, sending=sending, repeatable=repeatable)
            if wait is None:
                # Without its cause: the texts of a protocol error may repeat a header.
                raise failure from None
            yield wait


class PhotoFlows(Flows):
    """The calls of a client that sends photos."""

    def enroll(
        self,
        subject: str,
        photos: Photos,
        *,
        attributes: Mapping[str, str] | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> Flow[results.Enrollment]:
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
        files = yield lambda: _files("images", photos)
        return (yield from self._enroll(subject, replace, files=files, data=fields))

    def challenge(self, subject: str | None = None) -> Flow[results.Challenge]:
        """Ask for a challenge of head movements, for one verification. Right: ``verify``.

        With a subject, it can be answered for that one only.
        """
        body = _present(subject_id=subject)
        return self._send(results.Challenge, "POST", "/v1/challenges", json=body)

    def verify(
        self,
        subject: str,
        photos: Photos,
        *,
        level: str | None = None,
        face: Face | None = None,
        challenge: results.Challenge | None = None,
        holder_key: bytes | None = None,
    ) -> Flow[results.Decision]:
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
        files = yield lambda: _files("image", photos)
        return (yield from self._verify(subject, files=files, data=fields))

    def compare(
        self, first: Photo, second: Photo, *, level: str | None = None, face: Face | None = None
    ) -> Flow[results.Decision]:
        """Check whether two photos show one person; nothing is stored. Right: ``verify``.

        The `first` stands for an enrollment, and the `second` is decided as by :meth:`verify`. No
        attempt is counted on anybody, so a lost answer is asked for again.
        """
        files = yield lambda: _files("images", [first, second])
        fields = _present(level=level, face=face)
        return (
            yield from self._send(results.Decision, "POST", "/v1/compare", files=files, data=fields)
        )


class PrivateFlows(Flows):
    """The calls of a client that never sends a face: it lifts here, and sends templates."""

    def __init__(self, retries: Retries | None, lifter: Lifter) -> None:
        super().__init__(retries)
        self._lifter = lifter
        self._is_current = True

    def enroll(
        self,
        subject: str,
        photos: Photos | results.Enrollable,
        *,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> Flow[results.Enrollment]:
        """Lift photos here (or take a lift of :meth:`lift_enrollment`), and enroll by it alone.

        Rights: ``enroll``, ``embeddings``. Never enroll the same photos twice: two lifts of them
        give the embedding away. After an error repeat with its ``lift``.
        """
        fields = _present(holder_key=_encoded(holder_key))
        return self._lift_and_send(
            results.Enrollable,
            photos,
            face,
            lambda body: self._enroll(subject, replace, json=body | fields),
        )

    def verify(
        self,
        subject: str,
        photos: Photos | results.Probe,
        *,
        level: str | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
    ) -> Flow[results.Decision]:
        """Lift photos of one person here (or take a probe of :meth:`lift`), and verify by it.

        Rights: ``verify``, ``embeddings``. After an error repeat with its ``lift``, never with the
        photos.
        """
        fields = _present(level=level, holder_key=_encoded(holder_key))
        return self._lift_and_send(
            results.Probe, photos, face, lambda body: self._verify(subject, json=body | fields)
        )

    def lift_enrollment(
        self, photos: Photos, *, face: Face | None = None
    ) -> Flow[results.Enrollable]:
        """Lift photos of one person here, and send nothing of them.

        :meth:`enroll` takes the lift, as often as it must: it is one and the same write.
        """
        return self._lift(results.Enrollable, photos, face)

    def lift(self, photos: Photos, *, face: Face | None = None) -> Flow[results.Probe]:
        """Lift a probe here, of photos of one person; several subjects may be verified by it."""
        return self._lift(results.Probe, photos, face)

    def _lift(self, kind: type[L], photos: Photos, face: Face | None) -> Flow[L]:
        pictures: list[bytes] = yield lambda: read_photos(photos)
        inputs = self._lifter.inputs if self._is_current else None
        inputs = inputs or (yield from self._fetch())
        lift: L = yield lambda: self._lifter.lift(kind, inputs, pictures, face)
        return lift

    def _lift_and_send(
        self,
        kind: type[L],
        photos: Photos | L,
        face: Face | None,
        send: Callable[[dict[str, str]], Flow[T]],
    ) -> Flow[T]:
        """Send a lift. A resend repeats it; the error that ends it has it, so that callers can."""
        if isinstance(photos, kind):
            lift = photos
        else:
            lift = yield from self._lift(kind, cast("Photos", photos), face)
        try:
            return (yield from send({"template": base64.b64encode(lift.template).decode("ascii")}))
        except ContractMismatch:
            # Not lifted again here: a service that only claims to have changed would get two lifts.
            self._is_current = False
            raise
        except VeilfaceError as error:
            error.lift = lift
            error.add_note(
                "The service may have this lift: repeat the call with the error's `lift`, never "
                "with the photo. Two lifts of one photo give the embedding away."
            )
            raise

    def _fetch(self) -> Flow[LiftInputs]:
        for _ in range(3):
            contract = yield from self.contract()
            generator = yield from self.generator()
            # The contract may have changed between the two answers, or between two workers.
            if generator.source_id == contract.binding.get("decoy_source_id"):
                inputs: LiftInputs = yield partial(self._lifter.keep, contract, generator)
                self._is_current = True
                return inputs
        raise UnexpectedAnswer("the generator of the service is not that of its contract")


def _connection_failed(error: httpx.RequestError) -> ConnectionFailed:
    kind = type(error).__name__
    if isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout):
        cause = f": {error}" if str(error) else ""
        return ConnectionFailed(f"the service was not reached ({kind}{cause})", sent=False)
    return ConnectionFailed(
        f"no answer arrived ({kind}); the service may have done what was asked", sent=True
    )


def _path(subject: str, rest: str = "") -> str:
    """Return the path of a subject, whose id the service reads in NFC."""
    subject = unicodedata.normalize("NFC", subject)
    kinds = {unicodedata.category(each)[0] for each in subject if each not in "._@:-"}
    if not 0 < len(subject) <= 128 or subject in (".", "..") or not kinds <= set("LMN"):
        raise ValueError(
            "a subject id has 1 to 128 characters: letters, marks and digits, and . _ @ : -"
        )
    return f"/v1/subjects/{quote(subject, safe='@:')}{rest}"


def _id(text: str, what: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", text):
        raise ValueError(f"{what} an id of 1 to 64 characters out of A-Z a-z 0-9 _ -")
    return text


def _encoded(holder_key: bytes | None) -> str | None:
    if holder_key is None:
        return None
    if not isinstance(holder_key, bytes | bytearray) or len(holder_key) != HOLDER_KEY_BYTES:
        raise ValueError(f"a holder key is {HOLDER_KEY_BYTES} bytes: new_holder_key() makes one")
    return base64.urlsafe_b64encode(holder_key).decode("ascii").rstrip("=")


def _files(field: str, photos: Photos) -> list[tuple[str, tuple[str, bytes, str]]]:
    # A file name of the user's machine is nobody else's business.
    return [(field, ("photo", photo, "application/octet-stream")) for photo in read_photos(photos)]


def _present(**values: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}
