"""The server process, and the supervisor of its workers where there are several."""

import contextlib
import signal
import socket
import sys
from collections.abc import Callable

import uvicorn
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors.multiprocess import Multiprocess

from api.http.app import environment_of, uvicorn_options
from api.process.environment import variables_set
from api.settings import Settings


def run_server(settings: Settings, *, on_ready: Callable[[], None] = lambda: None) -> None:
    """Serve until told to stop.

    Parameters
    ----------
    settings
        What is served, where, and by how many workers.
    on_ready
        Called once, when all workers take connections.

    Raises
    ------
    SystemExit
        With a status other than 0 where the service, or one of its workers, could not start.
    """
    options = uvicorn_options(settings)
    config = uvicorn.Config(**options)
    if settings.workers == 1:
        server = OneWorker(config, on_ready)
        with contextlib.suppress(KeyboardInterrupt):
            server.run()
        if not server.started:
            sys.exit(STARTUP_FAILURE)
        return
    workers = Workers(config, [config.bind_socket()], on_ready)
    with variables_set(environment_of(settings)):
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


class Workers(Multiprocess):
    """uvicorn's supervisor, which notices at once when a worker dies.

    Every half second it asks each worker for a sign of life, through a pipe of which it holds both
    ends itself. A worker killed between question and answer would leave the supervisor waiting
    for all of ``timeout_worker_healthcheck``, deaf to other deaths and to the signal to stop.
    With the worker's end held by the worker alone, the pipe breaks when it dies.
    """

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

    def init_processes(self) -> None:
        """Start the workers."""
        super().init_processes()
        self._leave_the_workers_their_ends()

    def keep_subprocess_alive(self) -> None:
        """Replace workers that died or hang; give up where one could not start."""
        # Before too: a signal may have added a worker, and it is asked at once.
        self._leave_the_workers_their_ends()
        told = self.should_exit.is_set()
        super().keep_subprocess_alive()
        told = told or not {signal.SIGINT, signal.SIGTERM}.isdisjoint(self.signal_queue)
        self.gave_up = self.should_exit.is_set() and not told
        self._leave_the_workers_their_ends()
        self._say_when_ready()

    def _say_when_ready(self) -> None:
        if self._on_ready is None or self.should_exit.is_set():
            return
        patience = self.config.timeout_worker_healthcheck
        if all(process.is_ready(timeout=patience) for process in self.processes):
            self._on_ready()
            self._on_ready = None

    def _leave_the_workers_their_ends(self) -> None:
        for process in self.processes:
            process.child_conn.close()
