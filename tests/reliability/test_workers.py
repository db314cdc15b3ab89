"""Workers and their supervisor, when one of them dies at a bad moment."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from api.http.app import SIGN_OF_LIFE_S
from tests.api.deployment import deploy
from tests.patience import wait_until
from tests.ports import free_port
from tests.reliability.cluster import Cluster
from tests.reliability.kill import QUIET
from tests.reliability.operations import Clients, People
from tests.reliability.service import START_S, Service

pytestmark = pytest.mark.long


def children(service: Service) -> set[int]:
    return {child.pid for child in psutil.Process(service.process.pid).children()}


def says(service: Service, text: str) -> Callable[[], bool]:
    return lambda: any(text in line.get("event", "") for line in list(service.log))


def test_a_worker_that_dies_in_an_outage_comes_back_after_it(
    cluster: Cluster, tmp_path: Path
) -> None:
    deployment = deploy(tmp_path, database_url=cluster.url, port=free_port(), **QUIET)
    with Service(deployment, tmp_path) as service:
        clients = Clients(service, People(deployment, [1]))
        assert clients.enroll("a", 1).outcome == 201
        cluster.stop("fast")
        first, second = service.workers()
        service.kill_worker(first)
        wait_until(says(service, "the worker waits for it"))
        time.sleep(1.5)
        assert service.process.poll() is None
        assert service.workers() == [second]
        refused = clients.verify("a", 1)
        assert (refused.outcome, refused.code) == (503, "store_unavailable")
        cluster.start()
        wait_until(lambda: len(service.workers()) == 2)
        assert clients.verify("a", 1).accepted

        # A worker that waits can be told to stop.
        service.log.clear()
        cluster.stop("fast")
        service.kill_worker(second)
        wait_until(says(service, "the worker waits for it"))
        assert service.stop() == 0
        cluster.start()


def test_a_worker_killed_while_it_is_asked_for_a_sign_of_life_is_replaced_at_once(
    tmp_path: Path,
) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Service(deployment, tmp_path) as service:
        first = service.workers()[0]
        known = children(service)
        os.kill(first, signal.SIGSTOP)
        time.sleep(2)  # the supervisor asks every half second, and is waiting by now
        service.kill_worker(first)
        killed = time.monotonic()
        wait_until(lambda: bool(children(service) - known))
        # Sooner than the supervisor would give up waiting for the answer.
        assert time.monotonic() - killed < SIGN_OF_LIFE_S
        wait_until(lambda: len(service.workers()) == 2)
        assert service.stop() == 0


def test_the_service_fails_when_a_worker_cannot_start(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Service(deployment, tmp_path) as service:
        deployment.settings.resolved_decoys_file.write_bytes(b"no decoys")
        service.kill_worker(service.workers()[0])
        assert service.process.wait(timeout=START_S) == 1
        assert says(service, "start failed")()


def test_workers_end_with_their_supervisor(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    with Service(deployment, tmp_path) as service:
        clients = Clients(service, People(deployment, [1]))
        assert clients.enroll("a", 1).outcome == 201
        os.kill(service.process.pid, signal.SIGKILL)
        service.process.wait()
        wait_until(says(service, "the supervisor is gone"))
        wait_until(lambda: not service.is_ready())
        with Service(deployment, tmp_path) as again:
            assert Clients(again, People(deployment, [1])).verify("a", 1).accepted


def test_workers_share_what_the_supervisor_loaded(tmp_path: Path, mbf_pack_dir: Path) -> None:
    deployment = deploy(tmp_path, pack=mbf_pack_dir, port=free_port(), **QUIET)
    with Service(deployment, tmp_path, within=["env", "--unset", "OMP_NUM_THREADS"]) as service:
        # It has run an inference, with all threads of the matrix library, which end at a fork. One
        # that a library had kept would be missing in the workers: who waits for it waits for ever.
        assert psutil.Process(service.process.pid).num_threads() == 1
        for worker in service.workers():
            memory = psutil.Process(worker).memory_full_info()
            assert memory.uss < memory.rss / 2


def test_a_fork_that_fails_ends_the_service(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(
        "import itertools, os\n"
        "fork, forks = os.fork, itertools.count()\n"
        "def third_fails():\n"
        "    if next(forks) < 2:\n"
        "        return fork()\n"
        "    raise BlockingIOError(11, 'Resource temporarily unavailable')\n"
        "os.fork = third_fails\n"
    )
    deployment = deploy(tmp_path, port=free_port(), **QUIET)
    within = ["env", f"PYTHONPATH={tmp_path}"]
    with Service(deployment, tmp_path, within) as service:
        first, second = service.workers()
        service.kill_worker(first)
        assert service.process.wait(timeout=START_S) == 1
        assert not psutil.pid_exists(second)
