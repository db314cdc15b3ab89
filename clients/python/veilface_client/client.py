"""The blocking clients."""

import os
import ssl
import time
from collections.abc import Iterable, Iterator, Mapping
from types import TracebackType
from typing import Self, TypeVar

import httpx

from veilface_client import calls, flows, private_flows, results
from veilface_client.calls import Action, Call, Face
from veilface_client.connection import DEFAULT_TIMEOUT, options
from veilface_client.errors import UnexpectedAnswer
from veilface_client.flows import Flow, Send, Wait, Work
from veilface_client.lifting import Lifter
from veilface_client.lifts import Enrollable, Probe
from veilface_client.photos import Photo
from veilface_client.retries import DEFAULT_RETRIES, Retries

T = TypeVar("T")


class Session:
    """The calls that carry no face: what :class:`Client` and :class:`PrivateClient` share.

    Parameters
    ----------
    url
        Where the service is: ``https://faces.example.org``.
    token
        An API key.
    timeout
        Seconds, or an :class:`httpx.Timeout`: for each sending, not for all of them together.
    retries
        When and how often a call is sent again.
    verify
        As for httpx: whom to trust with TLS.
    transport
        As for httpx: how requests travel, for tests.
    """

    def __init__(
        self,
        url: str,
        token: str,
        *,
        timeout: httpx.Timeout | float = DEFAULT_TIMEOUT,
        retries: Retries = DEFAULT_RETRIES,
        verify: ssl.SSLContext | bool = True,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._retries = retries
        self._http = httpx.Client(
            **options(url, token, timeout=timeout, verify=verify), transport=transport
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self._http.base_url)!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def page(self, *, limit: int = 100, cursor: str | None = None) -> results.SubjectPage:
        """List one page of subjects. Right: ``enroll``."""
        return self._send(calls.page(limit=limit, cursor=cursor))

    def subjects(self, *, page_size: int = 100) -> Iterator[results.Subject]:
        """Iterate over all subjects, in the order of their ids, a page at a time."""
        cursor: str | None = None
        while True:
            page = self.page(limit=page_size, cursor=cursor)
            yield from page.subjects
            if page.next_cursor is None:
                return
            if page.next_cursor == cursor:
                raise UnexpectedAnswer("the page names itself as the next one")
            cursor = page.next_cursor

    def describe(self, subject: str) -> results.SubjectAnswer:
        """Describe a subject, without its template. Right: ``enroll``."""
        return self._send(calls.describe(subject))

    def erase(self, subject: str) -> results.Receipt:
        """Erase a subject, for good; keep the receipt. Right: ``erase``."""
        return self._send(calls.erase(subject))

    def lockout(self, subject: str) -> results.Lockout:
        """Count the failed attempts; :class:`NotFound` where there are none. Right: ``admin``."""
        return self._send(calls.lockout(subject))

    def reset_lockout(self, subject: str) -> results.Unlocked:
        """Forget the failed attempts, and enable the subject again. Right: ``admin``."""
        return self._send(calls.reset_lockout(subject))

    def contract(self) -> results.Contract:
        """Fetch the contract in force, with the key of receipts."""
        return self._send(calls.contract())

    def generator(self) -> results.Generator:
        """Fetch the decoy generator. Right: ``embeddings``."""
        return self._send(calls.generator())

    def export(self, subject: str) -> results.Export:
        """Export a subject, encrypted. Right: ``export``."""
        return self._send(calls.export(subject))

    def import_(self, exported: str | results.Export) -> results.Imported:
        """Import what :meth:`export` returned. Rights: ``export`` and ``admin``."""
        return self._send(calls.import_(exported))

    def create_token(
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
        return self._send(
            calls.create_token(subject, action, level=level, lifetime_s=lifetime_s, replace=replace)
        )

    def token_outcome(self, subject: str, token_id: str) -> results.TokenOutcome:
        """Ask what came of a token that this key asked for: never believe the page."""
        return self._send(calls.token_outcome(subject, token_id))

    def ready(self) -> results.Health:
        """Ask once whether the service can answer; otherwise :class:`Unavailable`."""
        return self._send(calls.ready())

    def _send(self, call: Call[T]) -> T:
        return self._run(flows.send(call, self._retries))

    def _run(self, flow: Flow[T]) -> T:
        try:
            step = next(flow)
            while True:
                try:
                    came = self._do(step)
                except Exception as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(came)
        except StopIteration as end:
            result: T = end.value
            return result
        finally:
            flow.close()

    def _do(self, step: Send | Wait | Work) -> object:
        match step:
            case Send(method, path, content):
                return self._http.request(method, path, **content)
            case Wait(seconds):
                time.sleep(seconds)
                return None
            case Work(function):
                return function()


class Client(Session):
    """Sends photos to the service, which embeds them; see :class:`Session` for the parameters.

    Examples
    --------
    ::

        with Client("https://faces.example.org", token) as client:
            client.enroll("anna", ["anna1.jpg", "anna2.jpg"])
            if client.verify("anna", "today.jpg"):
                ...
    """

    def enroll(
        self,
        subject: str,
        photos: Photo | Iterable[Photo],
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
            the service does not keep. Who loses it enrolls again.
        replace
            What may be replaced: whatever there is, nothing (False), or the enrollment of this
            ``template_id`` only; otherwise :class:`EnrollmentConflict`. A lost answer is then not
            asked for again: look with :meth:`describe` what is enrolled.
        """
        return self._run(
            flows.enroll(
                subject,
                photos,
                self._retries,
                attributes=attributes,
                face=face,
                holder_key=holder_key,
                replace=replace,
            )
        )

    def challenge(self, subject: str | None = None) -> results.Challenge:
        """Ask for a challenge of head movements, for one verification. Right: ``verify``.

        With a subject, it can be answered for that one only.
        """
        return self._send(calls.challenge(subject))

    def verify(
        self,
        subject: str,
        photos: Photo | Iterable[Photo],
        *,
        level: str | None = None,
        face: Face | None = None,
        challenge: results.Challenge | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Check whether 1 to 5 photos of one person show the subject. Right: ``verify``.

        A rejection is no error: the decision is false. Each rejection counts once on the subject's
        lockout, however many photos there were. An enrollment that was made with a
        ``holder_key`` rejects whoever sends another one, or none; any other ignores it.

        Parameters
        ----------
        challenge
            One of :meth:`challenge`: the photos are then the frames that answer it, in their
            order, as the camera gives them, not mirrored.
        """
        return self._run(
            flows.verify(
                subject,
                photos,
                self._retries,
                level=level,
                face=face,
                challenge=challenge,
                holder_key=holder_key,
            )
        )


class PrivateClient(Session):
    """Embeds and lifts in this process, and sends private templates only.

    Needs the extra ``private``; :class:`LiftUnavailable` where it is not installed.

    Parameters
    ----------
    url, token, timeout, retries, verify, transport
        As for :class:`Session`. The key needs the right ``embeddings``.
    pack
        The model pack of the service's contract.
    dim
        Dimension of probes; None: the largest that the contract takes.
    """

    def __init__(
        self,
        url: str,
        token: str,
        *,
        pack: str | os.PathLike[str],
        dim: int | None = None,
        timeout: httpx.Timeout | float = DEFAULT_TIMEOUT,
        retries: Retries = DEFAULT_RETRIES,
        verify: ssl.SSLContext | bool = True,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        self._lifter = Lifter(pack, dim=dim)
        super().__init__(
            url, token, timeout=timeout, retries=retries, verify=verify, transport=transport
        )

    def enroll(
        self,
        subject: str,
        photos: Photo | Iterable[Photo] | Enrollable,
        *,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> results.Enrollment:
        """Lift photos here (or take a lift of :meth:`lift_enrollment`), and enroll by it alone.

        Rights: ``enroll``, ``embeddings``. Never enroll the same photos twice: two lifts of them
        give the embedding away. After an error repeat with its ``lift``.
        """
        return self._run(
            private_flows.enroll(
                subject,
                photos,
                self._lifter,
                self._retries,
                face=face,
                holder_key=holder_key,
                replace=replace,
            )
        )

    def lift_enrollment(
        self, photos: Photo | Iterable[Photo], *, face: Face | None = None
    ) -> Enrollable:
        """Lift photos of one person here, and send nothing of them.

        :meth:`enroll` takes the lift, as often as it must: it is one and the same write.
        """
        return self._run(
            private_flows.lift_enrollment(photos, self._lifter, self._retries, face=face)
        )

    def lift(self, photos: Photo | Iterable[Photo], *, face: Face | None = None) -> Probe:
        """Lift a probe here, of photos of one person; several subjects may be verified by it."""
        return self._run(private_flows.lift_probe(photos, self._lifter, self._retries, face=face))

    def verify(
        self,
        subject: str,
        photos: Photo | Iterable[Photo] | Probe,
        *,
        level: str | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Lift photos of one person here (or take a probe of :meth:`lift`), and verify by it.

        Rights: ``verify``, ``embeddings``. After an error repeat with its ``lift``, never with the
        photos.
        """
        return self._run(
            private_flows.verify(
                subject,
                photos,
                self._lifter,
                self._retries,
                level=level,
                face=face,
                holder_key=holder_key,
            )
        )
