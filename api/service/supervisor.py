"""The server process, and the supervisor of its workers where there are several.

Workers are forks of the supervisor. What it has loaded, the contract and all modules,
is in memory once, and a worker in place of one that died starts at once.
"""

import contextlib
import gc
import logging
import multiprocessing
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors import multiprocess
from uvicorn.supervisors.multiprocess import SIGNALS, Multiprocess, Process

from api.http.app import uvicorn_options
from api.service.allocator import give_back
from api.service.logging import configure, log
from api.settings import Settings
from templates.contract.document import Contract


def run_server(
    settings: Settings, contract: Contract, *, on_ready: Callable[[], None] = lambda: None
) -> None:
    """Serve until told to stop.

    Parameters
    ----------
    settings
        What is served, where, and by how many workers.
    contract
        The one that the settings name.
    on_ready
        Called once, when all workers take connections.

    Raises
    ------
    SystemExit
        With a status other than 0 where the service, or one of its workers, could not start.
    """
    config = uvicorn.Config(**uvicorn_options(settings, contract))
    if settings.workers == 1:
        server = OneWorker(config, on_ready)
        with contextlib.suppress(KeyboardInterrupt):
            server.run()
        if not server.started:
            sys.exit(STARTUP_FAILURE)
        return
    configure(settings.log_level)
    # What workers share stays shared while nobody writes to it: the collector would.
    gc.collect()
    gc.freeze()
    give_back()
    workers = Workers(config, [config.bind_socket()], on_ready)
    workers.run()
    if workers.gave_up:
        sys.exit(STARTUP_FAILURE)


class OneWorker(uvicorn.Server):
    """uvicorn's server, which says when it takes connections."""

    def __init__(self, config: uvicorn.Config, on_ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._on_ready = on_ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application, listen, and say so."""
        await super().startup(sockets)
        self._on_ready()


class Worker(Process):
    """uvicorn's worker, as a fork of the supervisor.

    Every half second the supervisor asks each worker for a sign of life, through a pipe of which
    uvicorn lets it hold both ends. A worker killed between question and answer would leave it
    waiting for all of ``timeout_worker_healthcheck``, deaf to other deaths and to the signal to
    stop. With the worker's end held by the worker alone, the pipe breaks when it dies.
    """

    def __init__(self, config: uvicorn.Config, sockets: list[socket.socket]) -> None:
        super().__init__(config, sockets)
        forked = multiprocessing.get_context("fork").Process(target=self._serve, args=(sockets,))
        self.process = forked  # type: ignore[assignment]  # uvicorn's is spawned

    def start(self) -> None:
        """Fork; no signal comes between that and the worker's own handling of signals."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        try:
            super().start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self.child_conn.close()

    def _serve(self, sockets: list[socket.socket]) -> None:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        self.target(sockets)


# What the supervisor calls for a worker.
multiprocess.Process = Worker  # type: ignore[misc]


def _end(exitcode: int | None) -> str:
    """Name the signal that ended a process, or its exit status."""
    if exitcode is not None and exitcode < 0:
        return signal.Signals(-exitcode).name
    return f"exit status {exitcode}"


class Workers(Multiprocess):
    """uvicorn's supervisor, which says when all workers are ready, and why it stopped."""

    gave_up = False
    """Whether it stopped because a worker could not start, not because it was told to."""

    def __init__(
        self,
        config: uvicorn.Config,
        sockets: list[socket.socket],
        on_ready: Callable[[], None],
    ) -> None:
        super().__init__(config, sockets)
        self._on_ready: Callable[[], None] | None = on_ready

    def run(self) -> None:
        """Start workers and look after them until told to stop; none outlives a failure to."""
        try:
            super().run()
        except BaseException:
            self.terminate_all()
            self.join_all()
            raise

    def keep_subprocess_alive(self) -> None:
        """Replace workers that died or hang; give up where one could not start."""
        told = self.should_exit.is_set()
        before = list(self.processes)
        super().keep_subprocess_alive()
        for process in before:
            if process not in self.processes:
                log(
                    "a worker ended: another one takes its place",
                    severity=logging.ERROR,
                    pid=process.pid,
                    ended_by=_end(process.exitcode),
                )
        told = told or not {signal.SIGINT, signal.SIGTERM}.isdisjoint(self.signal_queue)
        self.gave_up = self.should_exit.is_set() and not told
        self._say_when_ready()

    def terminate_all(self) -> None:
        """Tell all workers to stop; nobody listens then, so a new connection does not wait."""
        for listening in self.sockets:
            listening.close()
        super().terminate_all()

    def _say_when_ready(self) -> None:
        if self._on_ready is None or self.should_exit.is_set():
            return
        patience = self.config.timeout_worker_healthcheck
        if all(process.is_ready(timeout=patience) for process in self.processes):
            self._on_ready()
            self._on_ready = None
