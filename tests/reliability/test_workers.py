"""Workers and their supervisor, when one of them dies at a bad moment."""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from tests.api.deployment import deploy
from tests.api.server_process import Server
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.reliability.kill import QUIET
from tests.reliability.operations import Clients, People

pytestmark = pytest.mark.long


def children(service: Server) -> set[int]:
    return {child.pid for child in psutil.Process(service.process.pid).children()}


def says(service: Server, text: str) -> Callable[[], bool]:
    return lambda: any(text in line.get("event", "") for line in service.lines())


def test_a_worker_that_is_killed_is_replaced_while_the_others_answer(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Server(deployment, tmp_path) as service:
        clients = Clients(service, People(deployment, [1]))
        assert clients.enroll("a", 1).outcome == 201
        first, second = service.workers()
        os.kill(first, signal.SIGKILL)
        assert clients.verify("a", 1).accepted
        wait_until(lambda: len(service.workers()) == 2)
        assert second in service.workers()
        assert service.stop() == 0


IMPATIENT = f"""
import sys
from api.cli import main
from api.service import server
server.SIGN_OF_LIFE_S = {2 * PATIENCE_S}
sys.argv = sys.argv[3:]
main()
"""
"""``veilface serve`` that waits longer for a worker's sign of life than this test for its end."""


def test_a_worker_that_is_killed_while_it_starts_does_not_delay_the_end(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Server(deployment, tmp_path, within=[sys.executable, "-c", IMPATIENT]) as service:
        before = children(service)
        os.kill(service.workers()[0], signal.SIGKILL)
        wait_until(lambda: children(service) - before)
        (starting,) = children(service) - before
        os.kill(starting, signal.SIGSTOP)
        # Now the first process asks it for a sign of life.
        time.sleep(2)
        os.kill(starting, signal.SIGKILL)
        assert service.stop() == 0


def test_the_service_fails_when_a_worker_cannot_start(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Server(deployment, tmp_path) as service:
        deployment.settings.resolved_decoys_file.write_bytes(b"no decoys")
        os.kill(service.workers()[0], signal.SIGKILL)
        assert service.process.wait(timeout=PATIENCE_S) == 1
        assert says(service, "start failed")()


def test_workers_end_with_the_first_process(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Server(deployment, tmp_path) as service:
        clients = Clients(service, People(deployment, [1]))
        assert clients.enroll("a", 1).outcome == 201
        os.kill(service.process.pid, signal.SIGKILL)
        service.process.wait()
        wait_until(says(service, "the first process is gone"))
        wait_until(lambda: not service.is_ready())
        with Server(deployment, tmp_path) as again:
            assert Clients(again, People(deployment, [1])).verify("a", 1).accepted
