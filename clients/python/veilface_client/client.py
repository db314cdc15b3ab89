"""The clients: flows driven by blocking calls, or by asyncio."""

import asyncio
import inspect
import os
import re
import ssl
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from functools import update_wrapper
from typing import Any, Concatenate, ParamSpec, Self, TypedDict, TypeVar, Unpack, get_args

import httpx

from veilface_client import results
from veilface_client.flows import Flow, Flows, PhotoFlows, PrivateFlows, Retries, Send
from veilface_client.lifting import Lifter

P = ParamSpec("P")
T = TypeVar("T")
M = TypeVar("M", bound=Callable[..., Any])

# Less than the 5 s after which the service closes an idle connection: a request that meets the
# close is lost, and a verification that is lost is not sent again.
_LIMITS = httpx.Limits(max_connections=100, max_keepalive_connections=20, keepalive_expiry=2.0)


class Options(TypedDict, total=False):
    """What every client may be given.

    Attributes
    ----------
    timeout
        Seconds, or an :class:`httpx.Timeout`: for each sending, not for all of them together. The
        default is 60 s, and 5 s to connect.
    retries
        When and how often a call is sent again.
    verify
        As for httpx: whom to trust with TLS.
    transport
        As for httpx: how requests travel, for tests.
    """

    timeout: httpx.Timeout | float
    retries: Retries
    verify: ssl.SSLContext | bool
    transport: Any


def _connection(url: str, token: str, options: Options) -> dict[str, Any]:
    """Return the arguments of httpx's clients; a `ValueError` repeats neither URL nor key."""
    try:
        base = httpx.URL(url)
    except httpx.InvalidURL:
        base = httpx.URL("")
    if base.scheme not in ("http", "https") or not base.host or base.userinfo or base.query:
        raise ValueError("the URL is that of the service: https://HOST[:PORT], without a password")
    # httpx would repeat a header that it cannot send in its error.
    if not re.fullmatch(r"[\x21-\x7e]+", token):
        raise ValueError("the API key has a character that no API key has, or is empty")
    return {
        "base_url": base,
        "headers": {"Authorization": f"Bearer {token}", "Accept": "application/json, */*"},
        "timeout": options.get("timeout", httpx.Timeout(60.0, connect=5.0, pool=5.0)),
        "verify": options.get("verify", True),
        "transport": options.get("transport"),
        "limits": _LIMITS,
        "follow_redirects": False,
    }


def _blocking(
    flow: Callable[Concatenate[Any, P], Flow[T]],
) -> "Callable[Concatenate[_Session, P], T]":
    """Make a flow a method of a blocking client, with its parameters and its docstring."""

    def method(self: "_Session", /, *args: P.args, **kwargs: P.kwargs) -> T:
        return self._run(flow(self._flows, *args, **kwargs))

    return _described(method, flow)


def _asynchronous(
    flow: Callable[Concatenate[Any, P], Flow[T]],
) -> "Callable[Concatenate[_AsyncSession, P], Coroutine[Any, Any, T]]":
    """Make a flow a method of an asynchronous client, with its parameters and its docstring."""

    async def method(self: "_AsyncSession", /, *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._run(flow(self._flows, *args, **kwargs))

    return _described(method, flow)


def _described(method: M, flow: Callable[..., Flow[Any]]) -> M:
    """Describe a method as its flow is, returning what the flow returns."""
    signature = inspect.signature(flow)
    result = get_args(signature.return_annotation)[-1]
    update_wrapper(method, flow, updated=())
    method.__signature__ = signature.replace(return_annotation=result)  # type: ignore[attr-defined]
    return method


class _Session:
    """A blocking client's connections, and the calls that carry no face."""

    def __init__(self, url: str, token: str, flows: Flows, options: Options) -> None:
        self._flows = flows
        self._http = httpx.Client(**_connection(url, token, options))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self._http.base_url)!r})"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def subjects(self, *, page_size: int = 100) -> Iterator[results.Subject]:
        """Iterate over all subjects, in the order of their ids, a page at a time."""
        cursor: str | None = None
        while True:
            page = self.page(limit=page_size, cursor=cursor)
            yield from page.subjects
            if (cursor := page.next_cursor) is None:
                return

    page = _blocking(Flows.page)
    describe = _blocking(Flows.describe)
    erase = _blocking(Flows.erase)
    lockout = _blocking(Flows.lockout)
    reset_lockout = _blocking(Flows.reset_lockout)
    contract = _blocking(Flows.contract)
    generator = _blocking(Flows.generator)
    export = _blocking(Flows.export)
    import_ = _blocking(Flows.import_)
    create_token = _blocking(Flows.create_token)
    token_outcome = _blocking(Flows.token_outcome)
    ready = _blocking(Flows.ready)

    def _run(self, flow: Flow[T]) -> T:
        came: object = None
        failed: Exception | None = None
        while True:
            try:
                step = flow.send(came) if failed is None else flow.throw(failed)
            except StopIteration as end:
                result: T = end.value
                return result
            came = failed = None
            try:
                match step:
                    case Send(method, path, content):
                        came = self._http.request(method, path, **content)
                    case float(seconds):
                        time.sleep(seconds)
                    case function:
                        came = function()
            except Exception as error:
                failed = error


class _AsyncSession:
    """As :class:`_Session`, on asyncio."""

    def __init__(self, url: str, token: str, flows: Flows, options: Options) -> None:
        self._flows = flows
        self._http = httpx.AsyncClient(**_connection(url, token, options))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self._http.base_url)!r})"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    async def subjects(self, *, page_size: int = 100) -> AsyncIterator[results.Subject]:
        """Iterate over all subjects, in the order of their ids, a page at a time."""
        cursor: str | None = None
        while True:
            page = await self.page(limit=page_size, cursor=cursor)
            for subject in page.subjects:
                yield subject
            if (cursor := page.next_cursor) is None:
                return

    page = _asynchronous(Flows.page)
    describe = _asynchronous(Flows.describe)
    erase = _asynchronous(Flows.erase)
    lockout = _asynchronous(Flows.lockout)
    reset_lockout = _asynchronous(Flows.reset_lockout)
    contract = _asynchronous(Flows.contract)
    generator = _asynchronous(Flows.generator)
    export = _asynchronous(Flows.export)
    import_ = _asynchronous(Flows.import_)
    create_token = _asynchronous(Flows.create_token)
    token_outcome = _asynchronous(Flows.token_outcome)
    ready = _asynchronous(Flows.ready)

    async def _run(self, flow: Flow[T]) -> T:
        came: object = None
        failed: Exception | None = None
        while True:
            try:
                step = flow.send(came) if failed is None else flow.throw(failed)
            except StopIteration as end:
                result: T = end.value
                return result
            came = failed = None
            try:
                match step:
                    case Send(method, path, content):
                        came = await self._http.request(method, path, **content)
                    case float(seconds):
                        await asyncio.sleep(seconds)
                    case function:
                        came = await asyncio.to_thread(function)
            except Exception as error:
                failed = error


class Client(_Session):
    """Sends photos to the service, which embeds them.

    Parameters
    ----------
    url
        Where the service is: ``https://faces.example.org``.
    token
        An API key.
    options
        See :class:`Options`.

    Examples
    --------
    ::

        with Client("https://faces.example.org", token) as client:
            client.enroll("anna", ["anna1.jpg", "anna2.jpg"])
            if client.verify("anna", "today.jpg"):
                ...
    """

    def __init__(self, url: str, token: str, **options: Unpack[Options]) -> None:
        super().__init__(url, token, PhotoFlows(options.get("retries")), options)

    enroll = _blocking(PhotoFlows.enroll)
    challenge = _blocking(PhotoFlows.challenge)
    verify = _blocking(PhotoFlows.verify)
    compare = _blocking(PhotoFlows.compare)


class PrivateClient(_Session):
    """Embeds and lifts in this process, and sends private templates only.

    Needs the extra ``private``; :class:`LiftFailed` where it is not installed.

    Parameters
    ----------
    url, token, options
        As for :class:`Client`. The key needs the right ``embeddings``.
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
        **options: Unpack[Options],
    ) -> None:
        flows = PrivateFlows(options.get("retries"), Lifter(pack, dim=dim))
        super().__init__(url, token, flows, options)

    enroll = _blocking(PrivateFlows.enroll)
    verify = _blocking(PrivateFlows.verify)
    lift_enrollment = _blocking(PrivateFlows.lift_enrollment)
    lift = _blocking(PrivateFlows.lift)


class AsyncClient(_AsyncSession):
    """As :class:`Client`, on asyncio."""

    def __init__(self, url: str, token: str, **options: Unpack[Options]) -> None:
        super().__init__(url, token, PhotoFlows(options.get("retries")), options)

    enroll = _asynchronous(PhotoFlows.enroll)
    challenge = _asynchronous(PhotoFlows.challenge)
    verify = _asynchronous(PhotoFlows.verify)
    compare = _asynchronous(PhotoFlows.compare)
