"""`veilface evaluate` on a Dask cluster of two workers."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import LocalCluster

from tests.api.cli.conftest import run
from tests.api.cli.evaluation_bench import secrets
from verify.evaluation import experiment


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalCluster]:
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        dashboard_address=":0",
        local_directory=str(tmp_path_factory.mktemp("workers")),
    ) as running:
        yield running


def refused(*given: Any, **named: Any) -> Any:
    raise AssertionError("this work belongs to the cluster")


@pytest.mark.long
def test_a_cluster_gives_the_same_bits(bench, results, cluster, tmp_path, monkeypatch):
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    # Workers are processes of their own: this one compares nothing.
    monkeypatch.setattr(experiment, "compare", refused)
    out = tmp_path / "out"
    ran = run(*bench.full, "--cluster", cluster.scheduler_address, "--out", out, "--json")
    assert ran.status == 0, ran.stderr
    monkeypatch.undo()
    for part in ("rows", "runs", "curves", "groups", "datasets", "decoys", "model"):
        assert ran.json[part] == results[part]
    assert ran.json["options"] == results["options"] | {"cluster": True}
    after = {process.pid for process in psutil.Process().children(recursive=True)}
    assert after <= before
    # Workers may write what they hold to files when memory is short.
    folders = (out, Path(cluster.workers[0].local_directory).parent)
    held = [file.read_bytes() for root in folders for file in root.rglob("*") if file.is_file()]
    assert not [needle for needle in secrets(bench) if needle in b"\n".join(held)]


def test_a_cluster_that_is_not_there_is_said_in_one_sentence(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("verify.evaluation.cluster.CONNECT_SECONDS", 0.5)
    ran = run(*bench.full, "--cluster", "tcp://127.0.0.1:1", "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (1, "")
    assert "error: no Dask scheduler answers at tcp://127.0.0.1:1" in ran.stderr
    assert "Traceback" not in ran.stderr
