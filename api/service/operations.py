"""What an operator's tools ask: readiness that is honest, a port of its own for it, and TLS."""

import logging
import socket
import ssl
import stat
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from functools import partial
from typing import Any

import anyio
import uvicorn
from starlette.types import ASGIApp

from api.http.errors import ApiError, StartError, api_error
from api.http.protocol import Protocol
from api.limits.admission import Gate
from api.service.logging import log
from api.service.metrics import MODEL_UP, STORE_UP
from api.service.opening import try_inference
from api.service.supervised import told_to_stop
from api.settings import Settings
from models.errors import ModelError
from models.pack import ModelPack
from templates.errors import StoreBusy, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.tenants import RetiredRotation

OPERATIONS_PATHS = frozenset({"/health/live", "/health/ready", "/metrics"})
WATCH_S = 5.0
CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2: forward secrecy and authenticated encryption. Those of TLS 1.3 are all like that."""


class Readiness:
    """Whether this worker can answer, by what it asks and by what requests ran into.

    A database may answer and yet take no write, and a model may be there and yet fail. So after a
    failure the thing that failed must succeed once before the worker is ready again.

    Parameters
    ----------
    store, pack, gate
        What is asked, and what bounds the asking; no pack is nothing to ask.
    keyring
        Whose source is watched: a log line tells when it cannot be followed any more.
    """

    def __init__(
        self,
        store: TemplateStore,
        pack: ModelPack | None,
        gate: Gate,
        keyring: MasterKeyring | None = None,
    ) -> None:
        self._store = store
        self._pack = pack
        self._gate = gate
        self._keyring = keyring
        self._stale = False
        self._failed: set[str] = set()
        self._on_trial: set[str] = set()
        self.stopping = False
        STORE_UP.set(1)
        MODEL_UP.set(1)

    def note(self, error: Exception) -> None:
        """Take note of an error that some work ended with, if it says that store or model fail."""
        known = api_error(error)
        if isinstance(error, ApiError) or known is None:
            return
        passing = isinstance(error, StoreBusy | RetiredRotation)
        if known.code == "store_unavailable" and isinstance(error, StoreError) and not passing:
            self._fail("store", error)
        elif known.code == "model_unavailable":
            self._fail("model", error)

    async def check(self) -> None:
        """Ask the database, and try again what failed last.

        Raises
        ------
        ApiError, StoreError, ModelError
            ``overloaded`` while the worker stops, ``store_unavailable``, ``model_unavailable``.
        """
        if self.stopping:
            raise ApiError(
                "overloaded",
                "this worker is stopping; try again, and another will answer",
                {"stopping": True},
                {"Retry-After": "5"},
            )
        try:
            await self._gate.query(self._store.ping)
            await self._again("store", lambda: self._store.ping_write(), self._gate.query)
            await self._again("model", self._infer, partial(self._gate.compute, key=""))
        except Exception as error:
            self.note(error)
            raise

    async def watch(self, *, every_s: float = WATCH_S) -> None:
        """Check now and then, so that metrics are right where nobody asks, until cancelled."""
        while not self.stopping:
            await anyio.sleep(every_s)
            self._watch_keys()
            try:
                await self.check()
            except Exception as error:
                # It is noted; and a line of its own tells when it begins and when it ends. Whatever
                # it was, the next look must come: this task ends with the worker only.
                log("check failed", severity=logging.DEBUG, error_type=type(error).__name__)

    def _watch_keys(self) -> None:
        stale = self._keyring is not None and self._keyring.stale_reason is not None
        if stale and not self._stale:
            # A rotation by another user, or a file that broke: we go on sealing under the old key.
            log("the master keys changed and cannot be read", severity=logging.ERROR)
        self._stale = stale

    async def _again(self, what: str, work: Callable[[], None], run: Callable[..., Any]) -> None:
        if what not in self._failed:
            return
        if what in self._on_trial:
            # One trial at a time: who asks meanwhile hears what is known.
            raise ApiError(
                f"{what}_unavailable",
                f"the {what} failed, and is on trial now",
                {},
                {"Retry-After": "1"},
            )
        self._on_trial.add(what)
        try:
            await run(work)
        finally:
            self._on_trial.discard(what)
        self._failed.discard(what)
        (STORE_UP if what == "store" else MODEL_UP).set(1)
        log(f"{what} is available again")

    def _infer(self) -> None:
        assert self._pack is not None  # noqa: S101 - no inference fails without a pack
        try:
            try_inference(self._pack)
        except StartError as error:
            raise ModelError(str(error)) from error

    def _fail(self, what: str, error: Exception) -> None:
        if what not in self._failed:
            log(
                f"{what} failed",
                severity=logging.ERROR,
                code=f"{what}_unavailable",
                error_type=type(error).__name__,
            )
        self._failed.add(what)
        (STORE_UP if what == "store" else MODEL_UP).set(0)


@contextmanager
def not_ready_once_told_to_stop(readiness: Readiness) -> Iterator[None]:
    """Mark the worker as stopping when the signal comes, before the server finishes requests.

    Only then is it too late to find that out from the server, which stops the application last.
    """

    def told() -> None:
        readiness.stopping = True

    with told_to_stop(told):
        yield


class _Beside(uvicorn.Server):
    """A second server of one process; the first one has the signals."""

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Leave them alone."""
        yield


@asynccontextmanager
async def operations_server(app: ASGIApp, *, host: str, port: int) -> AsyncIterator[int]:
    """Serve ``app`` on a port that all workers share; yields the port.

    The system hands each connection to one of the workers that have it open.

    Raises
    ------
    StartError
        The address is taken, or is none of this machine.
    """
    listener = _listener(host, port)
    config = uvicorn.Config(
        app,
        lifespan="off",
        http=Protocol,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=1,
    )
    server = _Beside(config)
    bound = int(listener.getsockname()[1])
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(server.serve, [listener])
        while not server.started:
            await anyio.sleep(0.01)
        try:
            yield bound
        finally:
            server.should_exit = True


def _listener(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise StartError(
            f"cannot listen on {host}:{port} ({error.strerror}); choose another operations_port "
            "or operations_host"
        ) from None
    return listener


def tls_options(settings: Settings) -> dict[str, Any]:
    """Return uvicorn's arguments for TLS, none where it is off, after a look at the files.

    Raises
    ------
    StartError
        If the key can be read by others, or certificate and key cannot be used.
    """
    certificate, key = settings.tls_certificate, settings.tls_key
    if certificate is None or key is None:
        return {}
    try:
        mode = stat.S_IMODE(key.stat().st_mode)
        if mode & 0o077:
            raise StartError(
                f"the file of tls_key may be read by others (mode {mode:04o}): `chmod 600` it, "
                "and replace the key if others could have read it"
            )
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        # A password must not be asked for on a terminal: there may be none.
        context.load_cert_chain(certificate, key, password=lambda: "")
    except FileNotFoundError as error:
        raise StartError("tls_certificate and tls_key must name files that exist") from error
    except (OSError, ValueError) as error:
        raise StartError(
            "tls_certificate and tls_key cannot be used: they must be PEM files that belong "
            "together, the key without a password"
        ) from error
    return {"ssl_certfile": certificate, "ssl_keyfile": key, "ssl_ciphers": CIPHERS}
