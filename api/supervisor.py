"""The server process, and the supervisor of its workers where there are several."""

import signal
import sys

import uvicorn
from uvicorn.config import STARTUP_FAILURE
from uvicorn.supervisors.multiprocess import Multiprocess

from api.app import environment_of, uvicorn_options
from api.environment import variables_set
from api.settings import Settings


def run_server(settings: Settings) -> None:
    """Serve until told to stop.

    Raises
    ------
    SystemExit
        With a status other than 0 where the service, or one of its workers, could not start.
    """
    options = uvicorn_options(settings)
    if settings.workers == 1:
        uvicorn.run(**options)
        return
    config = uvicorn.Config(**options)
    workers = Workers(config, [config.bind_socket()])
    with variables_set(environment_of(settings)):
        workers.run()
    if workers.gave_up:
        sys.exit(STARTUP_FAILURE)


class Workers(Multiprocess):
    """uvicorn's supervisor, which notices at once when a worker dies.

    Every half second it asks each worker for a sign of life, through a pipe of which it holds both
    ends itself. A worker killed between question and answer would leave the supervisor waiting
    for all of ``timeout_worker_healthcheck``, deaf to other deaths and to the signal to stop.
    With the worker's end held by the worker alone, the pipe breaks when it dies.
    """

    gave_up = False
    """Whether it stopped because a worker could not start, not because it was told to."""

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

    def _leave_the_workers_their_ends(self) -> None:
        for process in self.processes:
            process.child_conn.close()
