"""The asynchronous clients, on asyncio: each method as that of the blocking one."""

import asyncio
import os
import ssl
from collections.abc import AsyncIterator, Iterable, Mapping
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


class AsyncSession:
    """As :class:`veilface_client.client.Session`."""

    def __init__(
        self,
        url: str,
        token: str,
        *,
        timeout: httpx.Timeout | float = DEFAULT_TIMEOUT,
        retries: Retries = DEFAULT_RETRIES,
        verify: ssl.SSLContext | bool = True,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._retries = retries
        self._http = httpx.AsyncClient(
            **options(url, token, timeout=timeout, verify=verify), transport=transport
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self._http.base_url)!r})"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def page(self, *, limit: int = 100, cursor: str | None = None) -> results.SubjectPage:
        """List one page of subjects."""
        return await self._send(calls.page(limit=limit, cursor=cursor))

    async def subjects(self, *, page_size: int = 100) -> AsyncIterator[results.Subject]:
        """Iterate over all subjects, a page at a time."""
        cursor: str | None = None
        while True:
            page = await self.page(limit=page_size, cursor=cursor)
            for subject in page.subjects:
                yield subject
            if page.next_cursor is None:
                return
            if page.next_cursor == cursor:
                raise UnexpectedAnswer("the page names itself as the next one")
            cursor = page.next_cursor

    async def describe(self, subject: str) -> results.SubjectAnswer:
        """Describe a subject, without its template."""
        return await self._send(calls.describe(subject))

    async def erase(self, subject: str) -> results.Receipt:
        """Erase a subject, for good; keep the receipt."""
        return await self._send(calls.erase(subject))

    async def lockout(self, subject: str) -> results.Lockout:
        """Count the failed attempts on a subject."""
        return await self._send(calls.lockout(subject))

    async def reset_lockout(self, subject: str) -> results.Unlocked:
        """Forget the failed attempts, and enable the subject again."""
        return await self._send(calls.reset_lockout(subject))

    async def contract(self) -> results.Contract:
        """Fetch the contract in force."""
        return await self._send(calls.contract())

    async def generator(self) -> results.Generator:
        """Fetch the decoy generator."""
        return await self._send(calls.generator())

    async def export(self, subject: str) -> results.Export:
        """Export a subject, encrypted."""
        return await self._send(calls.export(subject))

    async def import_(self, exported: str | results.Export) -> results.Imported:
        """Import what :meth:`export` returned. Rights: ``export`` and ``admin``."""
        return await self._send(calls.import_(exported))

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
        return await self._send(
            calls.create_token(subject, action, level=level, lifetime_s=lifetime_s, replace=replace)
        )

    async def token_outcome(self, subject: str, token_id: str) -> results.TokenOutcome:
        """Ask what came of a token that this key asked for: never believe the page."""
        return await self._send(calls.token_outcome(subject, token_id))

    async def ready(self) -> results.Health:
        """Ask once whether the service can answer."""
        return await self._send(calls.ready())

    async def _send(self, call: Call[T]) -> T:
        return await self._run(flows.send(call, self._retries))

    async def _run(self, flow: Flow[T]) -> T:
        try:
            step = next(flow)
            while True:
                try:
                    came = await self._do(step)
                except Exception as error:
                    step = flow.throw(error)
                else:
                    step = flow.send(came)
        except StopIteration as end:
            result: T = end.value
            return result
        finally:
            flow.close()

    async def _do(self, step: Send | Wait | Work) -> object:
        match step:
            case Send(method, path, content):
                return await self._http.request(method, path, **content)
            case Wait(seconds):
                await asyncio.sleep(seconds)
                return None
            case Work(function):
                return await asyncio.to_thread(function)


class AsyncClient(AsyncSession):
    """As :class:`veilface_client.Client`."""

    async def enroll(
        self,
        subject: str,
        photos: Photo | Iterable[Photo],
        *,
        attributes: Mapping[str, str] | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> results.Enrollment:
        """Enroll a subject, or replace its enrollment."""
        return await self._run(
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

    async def challenge(self, subject: str | None = None) -> results.Challenge:
        """Ask for a challenge of head movements, for one verification."""
        return await self._send(calls.challenge(subject))

    async def verify(
        self,
        subject: str,
        photos: Photo | Iterable[Photo],
        *,
        level: str | None = None,
        face: Face | None = None,
        challenge: results.Challenge | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Check whether photos of one person show the subject."""
        return await self._run(
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


class AsyncPrivateClient(AsyncSession):
    """As :class:`veilface_client.PrivateClient`; lifting runs in a thread."""

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
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        self._lifter = Lifter(pack, dim=dim)
        super().__init__(
            url, token, timeout=timeout, retries=retries, verify=verify, transport=transport
        )

    async def enroll(
        self,
        subject: str,
        photos: Photo | Iterable[Photo] | Enrollable,
        *,
        face: Face | None = None,
        holder_key: bytes | None = None,
        replace: bool | str = True,
    ) -> results.Enrollment:
        """Lift photos here (or take a lift of :meth:`lift_enrollment`), and enroll by it alone."""
        return await self._run(
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

    async def lift_enrollment(
        self, photos: Photo | Iterable[Photo], *, face: Face | None = None
    ) -> Enrollable:
        """Lift photos of one person here, and send nothing of them."""
        return await self._run(
            private_flows.lift_enrollment(photos, self._lifter, self._retries, face=face)
        )

    async def lift(self, photos: Photo | Iterable[Photo], *, face: Face | None = None) -> Probe:
        """Lift a probe here, of photos of one person; several subjects may be verified by it."""
        return await self._run(
            private_flows.lift_probe(photos, self._lifter, self._retries, face=face)
        )

    async def verify(
        self,
        subject: str,
        photos: Photo | Iterable[Photo] | Probe,
        *,
        level: str | None = None,
        face: Face | None = None,
        holder_key: bytes | None = None,
    ) -> results.Decision:
        """Lift photos of one person here (or take a probe of :meth:`lift`), and verify by it."""
        return await self._run(
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
