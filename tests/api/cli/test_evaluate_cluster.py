"""`veilface evaluate` on a Dask cluster of two workers."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from distributed import LocalCluster

from models.pack import ModelPack
from tests.api.cli.conftest import run
from tests.api.cli.evaluation_bench import secrets
from verify.evaluation import embedder, evaluation


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


def address(cluster: LocalCluster) -> str:
    return str(cluster.scheduler_address).replace("tcp", "dask")


def refused(*given: Any, **named: Any) -> Any:
    raise AssertionError("this work belongs to the cluster")


@pytest.mark.long
def test_a_cluster_gives_the_same_bits(bench, results, cluster, tmp_path, monkeypatch):
    before = {process.pid for process in psutil.Process().children(recursive=True)}
    # Workers are processes of their own: this one must neither embed nor compare.
    for name in ("embed", "embed_both"):
        monkeypatch.setattr(ModelPack, name, refused)
    monkeypatch.setattr(evaluation, "run_unit", refused)
    out = tmp_path / "out"
    ran = run(*bench.full, "--backend", address(cluster), "--out", out, "--json")
    assert ran.status == 0, ran.stderr
    monkeypatch.undo()
    for part in ("rows", "runs", "curves", "groups", "datasets", "decoys", "model"):
        assert ran.json[part] == results[part]
    assert ran.json["options"] == results["options"] | {"backend": "dask"}
    after = {process.pid for process in psutil.Process().children(recursive=True)}
    assert after <= before
    # Workers may write what they hold to files when memory is short.
    folders = (out, Path(cluster.workers[0].local_directory).parent)
    held = [file.read_bytes() for root in folders for file in root.rglob("*") if file.is_file()]
    assert not [needle for needle in secrets(bench) if needle in b"\n".join(held)]


# Without the command, `tests/verify/evaluation/test_acquisition.py` has it in `make test`.
@pytest.mark.long
def test_a_worker_without_the_pack_is_said_in_one_sentence(bench, cluster, tmp_path, monkeypatch):
    plain: Callable[..., Any] = embedder.PackSource
    absent = tmp_path / "elsewhere"
    monkeypatch.setattr(
        embedder, "PackSource", lambda **named: plain(**(named | {"folder": absent}))
    )
    ran = run(*bench.full, "--backend", address(cluster), "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (1, "")
    assert ran.stderr.splitlines()[-1] == (
        f"error: a worker does not find the pack {absent}: it must lie at the same path there"
    )
    assert "Traceback" not in ran.stderr


def test_a_cluster_that_is_not_there_is_said_in_one_sentence(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("verify.evaluation.backends.CONNECT_SECONDS", 0.5)
    ran = run(*bench.full, "--backend", "dask://127.0.0.1:1", "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (1, "")
    assert "error: no Dask scheduler answers at tcp://127.0.0.1:1" in ran.stderr
    assert "Traceback" not in ran.stderr
