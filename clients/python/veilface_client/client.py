"""The clients: the calls on asyncio, and the same calls driven without it."""

import asyncio
import os
import re
import ssl
import time
from collections.abc import Callable, Coroutine, Iterator
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypedDict, TypeVar, Unpack

import httpx

from veilface_client import results
from veilface_client.calls import Calls, Channel, PhotoCalls, PrivateCalls, Retries

P = ParamSpec("P")
T = TypeVar("T")

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


class AsyncClient(PhotoCalls):
    """As :class:`Client`, on asyncio."""

    def __init__(self, url: str, token: str, **options: Unpack[Options]) -> None:
        self._http = httpx.AsyncClient(**_connection(url, token, options))
        channel = Channel(self._http.request, asyncio.sleep, asyncio.to_thread)
        super().__init__(channel, options.get("retries"))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self._http.base_url)!r})"

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()


def _at_once(function: Callable[P, T]) -> Callable[P, Coroutine[Any, Any, T]]:
    """Make a coroutine function that blocks and is never suspended."""

    async def call(*args: P.args, **kwargs: P.kwargs) -> T:
        return function(*args, **kwargs)

    return call


def _call(function: Callable[..., T], *args: Any) -> T:
    return function(*args)


def _blocking(
    call: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]],
) -> "Callable[Concatenate[_Session, P], T]":
    """Make a call a method of a blocking client, with its parameters and its docstring."""

    @wraps(call)
    def method(self: "_Session", /, *args: P.args, **kwargs: P.kwargs) -> T:
        try:
            call(self._calls, *args, **kwargs).send(None)
        except StopIteration as end:
            result: T = end.value
            return result
        raise RuntimeError("a call over a blocking channel was suspended")

    return method


class _Session:
    """A blocking client's connections, and the calls that carry no face."""

    _calls: Calls

    def __init__(self, url: str, token: str, options: Options) -> None:
        self._http = httpx.Client(**_connection(url, token, options))
        self._channel = Channel(_at_once(self._http.request), _at_once(time.sleep), _at_once(_call))

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
        page = self.page(limit=page_size)
        yield from page.subjects
        while page.next_cursor is not None:
            page = self.page(limit=page_size, cursor=page.next_cursor)
            yield from page.subjects

    page = _blocking(Calls.page)
    describe = _blocking(Calls.describe)
    erase = _blocking(Calls.erase)
    lockout = _blocking(Calls.lockout)
    reset_lockout = _blocking(Calls.reset_lockout)
    contract = _blocking(Calls.contract)
    generator = _blocking(Calls.generator)
    export = _blocking(Calls.export)
    import_ = _blocking(Calls.import_)
    create_token = _blocking(Calls.create_token)
    token_outcome = _blocking(Calls.token_outcome)
    ready = _blocking(Calls.ready)


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
        super().__init__(url, token, options)
        self._calls = PhotoCalls(self._channel, options.get("retries"))

    enroll = _blocking(PhotoCalls.enroll)
    challenge = _blocking(PhotoCalls.challenge)
    verify = _blocking(PhotoCalls.verify)
    compare = _blocking(PhotoCalls.compare)


class PrivateClient(_Session):
    """Embeds and lifts in this process, and sends private templates only.

    Needs the extra ``private``: without it, a lift raises :class:`LiftFailed`.

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
        super().__init__(url, token, options)
        retries = options.get("retries")
        self._calls = PrivateCalls(self._channel, retries, pack=Path(pack), dim=dim)

    enroll = _blocking(PrivateCalls.enroll)
    verify = _blocking(PrivateCalls.verify)
    lift_enrollment = _blocking(PrivateCalls.lift_enrollment)
    lift = _blocking(PrivateCalls.lift)
