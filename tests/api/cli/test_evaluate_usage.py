"""What `veilface evaluate` refuses, before any face is embedded."""

import json

import numpy as np
import pytest

from models.pack import ModelPack
from tests.api.cli.conftest import run
from verify.evaluation import experiment

USAGE: list[tuple[list[str], str]] = [
    (["--strategy", "homomorphic"], "choose of raw, random"),
    (["--strategy", ","], "--strategy takes a list of raw, random"),
    (["--strategy", "adversarial"], "make one with `veilface decoys build`"),
    (["--strategy", "hybrid+", "--decoys", "GENERATOR"], "a pool with gender and race labels"),
    (["--strategy", "sub-hybrid", "--decoys", "GENERATOR"], "sub-hybrid lifting needs a pool"),
    (["--dim", "two"], "--dim takes whole numbers from 1 to 10000, with commas, not 'two'"),
    (["--dim", "0"], "--dim takes whole numbers from 1"),
    (["--dim", "2,256", "--strategy", "random"], "takes dimensions from 1 to 192, not 256"),
    (["--mode", "p2p"], "--mode takes a list of p2s, s2s, not 'p2p'"),
    (["--metric", "cosine"], "--metric takes a list of euclidean, spherical"),
    (["--fmr", "low"], "--fmr takes rates such as 1e-2, not 'low'"),
    (["--fmr", "1"], "FMR targets lie between 0 and 1, such as 1e-2"),
    (["--pack", "none"], "give a pack, or `--pack none --embeddings FILE`"),
    (["--embeddings", "EMBEDDINGS"], "give a pack, or `--pack none --embeddings FILE`"),
    (["--pack", "none", "--embeddings", "EMBEDDINGS", "--flip"], "--flip needs a pack"),
    (["LFW"], "two sets have one name (lfw, lfw)"),
    (["--decoys", "POOL", "--decoys", "POOL"], "give one pool and one generator at most"),
    (["--decoys", "POOL", "--dim", "100"], "draws 100 decoys, and one of 2 parts of the pool has"),
]
FAILED: list[tuple[list[str], str]] = [
    (["--decoys", "POOL", "--flip"], "build the decoys with this pack and the same --flip"),
    (
        ["--pack", "none", "--embeddings", "EMBEDDINGS", "--decoys", "POOL"],
        "decoys of 256 numbers each, the embeddings have 32; build the decoys with their pack",
    ),
    (["--decoys", "ABSENT"], "absent: No such file or directory"),
    (["--labels", "ABSENT"], "absent is not there"),
    (["--labels", "AUDIT"], "audit.json has no row below the header"),
]


@pytest.mark.parametrize(
    ("arguments", "reason", "status"),
    [(*one, 2) for one in USAGE] + [(*one, 1) for one in FAILED],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_cannot_be_done_is_said_before_any_face_is_embedded(
    bench, tmp_path, monkeypatch, arguments, reason, status
):
    monkeypatch.setattr(experiment, "evaluate", None)
    monkeypatch.setattr(ModelPack, "embed", None)
    rows = np.eye(32, dtype=np.float32)
    paths = np.array([f"{i}.png" for i in range(32)])
    np.savez(tmp_path / "embeddings.npz", paths=paths, descriptors=rows)
    (tmp_path / "audit.json").write_text(
        json.dumps({"format": "veilface audit", "rows": [{"strategy": "random"}]})
    )
    files = {
        **{"LFW": bench.lfw, "LABELS": bench.labels, "ABSENT": tmp_path / "absent"},
        **{"POOL": bench.root / "pool.veil", "GENERATOR": bench.root / "generator.veil"},
        **{"EMBEDDINGS": tmp_path / "embeddings.npz", "AUDIT": tmp_path / "audit.json"},
    }
    given = [files.get(argument, argument) for argument in arguments]
    ran = run("evaluate", bench.lfw, *bench.base, *given, "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (status, "")
    (sentence,) = [line for line in ran.stderr.splitlines() if not line.startswith("note: lfw")]
    assert sentence.startswith("error: ")
    assert reason in sentence
    assert "defect" not in sentence
    assert not (tmp_path / "out").exists()


def test_options_of_a_wrong_kind_are_refused(bench, tmp_path):
    for wrong in (["--repeats", "0"], ["--seed", "-1"], ["--jobs", "0"], ["--no-such-option"]):
        ran = run("evaluate", bench.lfw, *bench.base, *wrong, "--out", tmp_path / "out")
        assert (ran.status, ran.stdout) == (2, "")
        assert wrong[0] in ran.stderr
        assert "Traceback" not in ran.stderr
    assert run("evaluate", tmp_path / "absent", *bench.base).status == 1


def test_a_cluster_that_is_not_there_is_said_in_one_sentence(bench, tmp_path, monkeypatch):
    monkeypatch.setattr("verify.evaluation.cluster.CONNECT_SECONDS", 0.5)
    ran = run(*bench.full, "--cluster", "tcp://127.0.0.1:1", "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (1, "")
    assert "error: no Dask scheduler answers at tcp://127.0.0.1:1" in ran.stderr
