"""The experiment on a Dask cluster of two processes."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.metadata import version

import dask
import numpy as np
import pytest
from distributed import LocalCluster, get_worker

from tests.verify.evaluation.made_trials import made_trials
from verify.evaluation import cluster as module
from verify.evaluation.cluster import ClusterError, cluster
from verify.evaluation.comparison import Trials
from verify.evaluation.experiment import ARRAYS, run_trials
from verify.evaluation.plan import EvaluationPlan


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """A scheduler that gives a task up at its first lost worker, and two workers."""
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        LocalCluster(  # type: ignore[no-untyped-call]
            n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0"
        ) as running,
    ):
        yield running.scheduler_address


def kept_embeddings(known: Trials, _: int) -> tuple[int, bool]:
    """Process of a worker, and whether what it may spill has the embeddings of its task."""
    values = get_worker().data.values()  # type: ignore[no-untyped-call]
    return os.getpid(), any(known.embeddings.tobytes() in dask_bytes(value) for value in values)


def dask_bytes(value: object) -> bytes:
    embeddings = getattr(value, "embeddings", None)
    return b"" if embeddings is None else embeddings.tobytes()


def die(_: int) -> None:
    os._exit(1)


def test_a_cluster_gives_the_same_runs(address: str) -> None:
    plan = EvaluationPlan(("raw", "adversarial"), dims=(2, 3), repeats=2, targets=(0.1,))
    done: list[int] = []
    found = []
    for workers in (ThreadPoolExecutor(1), ThreadPoolExecutor(3), cluster(address)):
        with workers as executor:
            found.append(run_trials(made_trials(), plan, executor=executor, progress=done.append))
    assert sum(done) == 3 * (1 + 2 * 2)
    for runs in found[1:]:
        assert runs.drop(columns=ARRAYS).equals(found[0].drop(columns=ARRAYS))
        for name in ARRAYS:
            np.testing.assert_array_equal(np.stack(runs[name]), np.stack(found[0][name]))


def test_a_worker_has_no_embedding_where_it_may_write_to_disk(address: str) -> None:
    with cluster(address) as executor:
        seen = list(executor.map(partial(kept_embeddings, made_trials()), range(8)))
    assert os.getpid() not in {process for process, _ in seen}
    assert not any(kept for _, kept in seen)


def test_a_worker_of_another_version_is_refused(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = os.getpid()
    monkeypatch.setattr(
        module, "version", lambda name: version(name) if os.getpid() == here else "0.0.0"
    )
    with pytest.raises(ClusterError, match="install one version everywhere"), cluster(address):
        pass


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_worker_that_ends_in_the_middle_is_said(address: str) -> None:
    with (
        pytest.raises(ClusterError, match="most often because memory ran out"),
        cluster(address) as executor,
    ):
        list(executor.map(die, range(1)))


@pytest.mark.parametrize("absent", ["tcp://127.0.0.1:1", "ray://head:1", "no address"])
def test_a_scheduler_that_is_not_there(absent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CONNECT_SECONDS", 0.5)
    with pytest.raises(ClusterError, match="no Dask scheduler answers at"), cluster(absent):
        pass
