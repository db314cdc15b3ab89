import os
import pickle
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from cryptography.exceptions import InvalidTag
from distributed import Client, LocalCluster

from tests.verify.evaluation.materials import material
from tests.verify.evaluation.tasks import add, die, kept_open, process
from verify.evaluation import backends
from verify.evaluation.backends import Backend, BackendError, spread
from verify.evaluation.material import Parcel, fresh_key

SECRET = b"a face descriptor"


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A scheduler and two workers, each a process of its own."""
    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
    ) as running:
        yield running.scheduler_address


def test_addresses() -> None:
    assert Backend.parse("local", jobs=2) == Backend(None, 2)
    assert Backend.parse("dask://10.0.0.1:8786", jobs=2).scheduler == "tcp://10.0.0.1:8786"
    assert Backend.parse("dask+tls://head:8786", jobs=2).scheduler == "tls://head:8786"


@pytest.mark.parametrize(
    "text", ["", "dask", "dask://", "dask://host", "dask://host:x", "http://host:1", "dask://h:1/x"]
)
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(BackendError, match="use local, or dask://HOST:PORT"):
        Backend.parse(text, jobs=1)


@pytest.mark.parametrize("jobs", [1, 2])
def test_local_work_is_done_in_as_many_processes(jobs: int, tmp_path: Path) -> None:
    backend = Backend(None, jobs)
    assert sorted(spread(backend, add, 100, range(5))) == [(i, 100 + i) for i in range(5)]
    processes = {pid for _, pid in spread(backend, process, (tmp_path, jobs), range(4))}
    assert len(processes) == jobs
    assert (os.getpid() in processes) is (jobs == 1)
    assert list(spread(backend, add, 1, [])) == []


def test_a_cluster_does_the_same_work(cluster: str, tmp_path: Path) -> None:
    backend = Backend.parse(cluster.replace("tcp", "dask"), jobs=1)
    assert sorted(spread(backend, add, 100, range(5))) == [(i, 100 + i) for i in range(5)]
    processes = {pid for _, pid in spread(backend, process, (tmp_path, 2), range(4))}
    assert os.getpid() not in processes


def test_workers_of_a_cluster_keep_nothing(cluster: str) -> None:
    list(spread(Backend(cluster, 1), add, 100, range(4)))
    with Client(cluster, set_as_default=False) as client:  # type: ignore[no-untyped-call]
        assert set(client.run(kept_open).values()) == {0}


@pytest.mark.filterwarnings("ignore:A worker stopped:UserWarning")
def test_a_worker_that_ends_in_the_middle_is_said(tmp_path: Path) -> None:
    with pytest.raises(BackendError, match="most often because memory ran out: use fewer jobs"):
        list(spread(Backend(None, 2), die, None, range(2)))


def rivals(shared: object, item: float) -> int:
    """How many tasks run in this process while this one does."""
    backends_running.append(item)
    time.sleep(0.05)
    seen = len(backends_running)
    backends_running.remove(item)
    return seen


backends_running: list[float] = []


def test_tasks_of_one_process_take_turns() -> None:
    key = fresh_key()
    shared = Parcel.pack(None, key)
    here = backends.version("veilface")
    with ThreadPoolExecutor(4) as threads:
        calls = [
            threads.submit(backends._call, rivals, here, shared, i, Parcel.pack(i, key), key)
            for i in range(4)
        ]
        assert [call.result()[1].open(key) for call in calls] == [1, 1, 1, 1]


def test_a_scheduler_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backends, "CONNECT_SECONDS", 0.5)
    with pytest.raises(BackendError, match="no Dask scheduler answers"):
        list(spread(Backend("tcp://127.0.0.1:1", 1), add, 0, [1, 2]))


def test_a_parcel_shows_nothing_and_opens_with_its_key_only() -> None:
    key = fresh_key()
    known = material(people=3, pairs=20)
    parcel = Parcel.pack((SECRET, known), key)
    carried = pickle.dumps(parcel) + repr(parcel).encode()
    assert SECRET not in carried
    assert known.descriptors[0].tobytes() not in carried
    opened = parcel.open(key)
    assert isinstance(opened, tuple)
    np.testing.assert_array_equal(opened[1].descriptors, known.descriptors)
    with pytest.raises(InvalidTag):
        parcel.open(fresh_key())
    changed = Parcel(parcel.sealed[:-1] + bytes([parcel.sealed[-1] ^ 1]), parcel.digest)
    with pytest.raises(InvalidTag):
        changed.open(key)


def test_a_worker_of_another_version_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    key = fresh_key()
    shared, item = Parcel.pack(1, key), Parcel.pack(2, key)
    index, found = backends._call(add, backends.version("veilface"), shared, 7, item, key)
    assert (index, found.open(key)) == (7, 3)
    with pytest.raises(BackendError, match="install one version everywhere"):
        backends._call(add, "0.0.0", shared, 7, item, key)
