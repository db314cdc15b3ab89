"""The server: uvicorn with one worker in this process, or with several processes."""

import contextlib
import logging
import multiprocessing
import os
import signal
import socket
import ssl
import stat
import sys
import threading
from functools import partial
from typing import Any

import uvicorn
from fastapi import FastAPI
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors import Multiprocess, multiprocess

from api.http.app import create_app
from api.http.errors import StartError
from api.http.protocol import Protocol
from api.service.logging import configure, log
from api.service.metrics import shared_directory
from api.service.opening import Deployment
from api.service.runtime import Runtime
from api.settings import NO_PROXIES, Settings
from templates.contract.document import Contract

GRACE_S = 20
SIGN_OF_LIFE_S = 30
"""Seconds in which a worker must show that it lives; on a busy machine, uvicorn's five are few."""

BACKLOG = 2048
CIPHERS = "ECDHE+AESGCM:ECDHE+CHACHA20"
"""Of TLS 1.2: forward secrecy and authenticated encryption. Those of TLS 1.3 are all like that."""


def run_server(deployment: Deployment, listener: socket.socket) -> None:
    """Serve until told to stop; exit with another status than 0 where a worker could not start.

    One worker, this process, answers with the :class:`Runtime` that it is given, and closes it.
    Several open their own of the same settings and contract, also one in place of one that died.
    """
    settings = deployment.settings
    configure(settings.log_level)
    config = uvicorn.Config(**uvicorn_options(deployment))
    if isinstance(deployment, Runtime):
        server = uvicorn.Server(config)
        with contextlib.suppress(KeyboardInterrupt):
            server.run([listener])
        failed = not server.started
    else:
        with shared_directory():
            workers = _Workers(config, [listener])
            workers.run()
        failed = any(process.exitcode == STARTUP_FAILURE for process in workers.processes)
    if failed:
        sys.exit(STARTUP_FAILURE)


class _Workers(Multiprocess):
    """uvicorn's workers. While they finish their requests, nobody listens: nobody is kept waiting.

    The signal reaches the workers, which close their own ends of the socket; this is the last.
    """

    def terminate_all(self) -> None:
        """Stop listening, and tell all workers to stop."""
        for listener in self.sockets:
            listener.close()
        super().terminate_all()


class _Worker(multiprocess.Process):
    """uvicorn's worker, which alone holds its end of the pipe that asks for a sign of life.

    The first process would otherwise wait for a dead worker's answer for all of the time that a
    living one has, deaf to other deaths and to the signal to stop.
    """

    def start(self) -> None:
        """Start the process, and let go of its end."""
        super().start()
        self.child_conn.close()


# What uvicorn's supervisor calls for a worker.
multiprocess.Process = _Worker  # type: ignore[misc]


def _worker_app(settings: Settings, contract: Contract) -> FastAPI:
    """Make a worker's application; the worker ends with the process that started it.

    It would hold the port otherwise, and a service that is started again could not listen.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None  # noqa: S101 - uvicorn starts workers as processes
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()
    return create_app(settings, open_runtime=partial(Runtime.open, contract=contract))


def _end_after(parent: multiprocessing.process.BaseProcess) -> None:
    parent.join()
    log("the first process is gone: the worker stops", severity=logging.ERROR, pid=os.getpid())
    signal.raise_signal(signal.SIGTERM)


def uvicorn_options(deployment: Deployment) -> dict[str, Any]:
    """Return the keyword arguments of ``uvicorn.Config``."""
    settings = deployment.settings
    if isinstance(deployment, Runtime):
        app = partial(create_app, settings, open_runtime=lambda _: deployment)
    else:
        app = partial(_worker_app, settings, deployment.contract)
    return {
        "app": app,
        "factory": True,
        "workers": settings.workers,
        "log_config": None,
        "access_log": False,
        "http": Protocol,
        "ws": "none",
        "backlog": BACKLOG,
        "server_header": False,
        "timeout_graceful_shutdown": GRACE_S,
        "timeout_worker_healthcheck": SIGN_OF_LIFE_S,
        "proxy_headers": settings.trusted_proxies != NO_PROXIES,
        "forwarded_allow_ips": settings.trusted_proxies,
        **tls_options(settings),
    }


def listen(settings: Settings) -> socket.socket:
    """Open the port; connections wait for the first worker from now on."""
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((settings.host, settings.port))
        listener.listen(BACKLOG)
    except OSError as error:
        listener.close()
        raise StartError(
            f"cannot listen on {settings.host}:{settings.port} ({error.strerror}); choose another "
            "--port or --host"
        ) from None
    return listener


def tls_options(settings: Settings) -> dict[str, Any]:
    """Return uvicorn's arguments for TLS, none where it is off, after a look at the files."""
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
        # A password must not be asked for on a terminal: there may be none.
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(certificate, key, password=lambda: "")
    except (OSError, ValueError) as error:
        raise StartError(
            "tls_certificate and tls_key cannot be used: they must be PEM files that exist and "
            "belong together, the key without a password"
        ) from error
    return {"ssl_certfile": certificate, "ssl_keyfile": key, "ssl_ciphers": CIPHERS}
