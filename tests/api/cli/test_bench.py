"""`veilface bench`: what it times, not how long that takes."""

from pathlib import Path

import numpy as np
import pytest

from api.cli import bench_distances
from api.cli.bench_distances import authors_distances, face_like, face_like_templates
from templates.distances import pairwise_distances
from templates.keys.randomness import Keystream
from tests.api.cli.conftest import run
from tests.api.deployment import photo, write_pack

DISTANCES = ("bench", "distances", "--count", "9", "--n", "12,24", "--dim", "2,3", "--repeats", "3")
MODELS = ("bench", "models")


def test_distances_are_timed_for_every_combination(monkeypatch):
    monkeypatch.setattr(bench_distances, "REST_S", 0)
    shown = run(*DISTANCES, "--json")
    assert shown.status == 0, shown.stderr
    assert [(row["n"], row["m"], row["mode"], row["metric"]) for row in shown.json["rows"]] == [
        (n, m, mode, metric)
        for n in (12, 24)
        for m in (2, 3)
        for mode in ("p2s", "s2s")
        for metric in ("euclidean", "spherical")
    ]
    for row in shown.json["rows"]:
        assert min(row["product"], row["distances"], row["authors"]) > 0
        assert row["low"] <= row["to_product"] <= row["high"]
    assert run(*DISTANCES).stdout.count("s2s") == 8


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--dim", "2,24"), "--dim takes whole numbers from 1 to 11, with commas, not '2,24'"),
        (("--dim", "few"), "--dim takes whole numbers from 1 to 11, with commas, not 'few'"),
        (("--n", "1"), "--n takes whole numbers from 2 to 10000, with commas, not '1'"),
        (("--repeats", "0"), "repeats"),
    ],
)
def test_distances_refuse_wrong_usage(arguments, said):
    shown = run(*DISTANCES, *arguments)
    assert (shown.status, shown.stdout) == (2, "")
    assert said in shown.stderr


@pytest.mark.parametrize("device", ["cuda:99", "nonsense"])
def test_a_device_that_is_not_there_is_refused(device):
    pytest.importorskip("torch")
    shown = run(*DISTANCES, "--device", device)
    assert shown.status == 1
    assert f"torch cannot use the device {device}: " in shown.stderr


def test_the_authors_formula_gives_the_distances():
    stream = Keystream.seeded("authors")
    templates = face_like_templates(9, 3, 64, stream=stream)
    for probes in (face_like(8, 64, stream=stream), face_like_templates(8, 2, 64, stream=stream)):
        np.testing.assert_allclose(
            authors_distances(probes, templates),
            pairwise_distances(probes, templates, metric="euclidean"),
            rtol=1e-4,
        )


def test_embeddings_are_spread_like_faces():
    rows = face_like(4000, 64, stream=Keystream.seeded("spread")).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(rows, axis=1), 1, atol=1e-6)
    assert np.linalg.norm(rows.mean(axis=0)) > 0.05
    spectrum = np.linalg.eigvalsh(np.cov(rows.T))
    assert spectrum[-1] > 4 * spectrum[0]


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    return write_pack(tmp_path / "tiny")


def test_a_pack_is_timed_with_every_setting_and_the_best_is_advised(pack, tmp_path, monkeypatch):
    monkeypatch.setattr("api.cli.bench_models.processors", lambda: 2)
    own = tmp_path / "own.png"
    own.write_bytes(photo(1))
    timed = (*MODELS, own, "--pack", pack, "--repeats", "2", "--threads", "1,2")
    shown = run(*timed, "--json")
    assert shown.status == 0, shown.stderr
    rows = shown.json["photos"]
    assert [(row["callers"], row["onnx_threads"], row["compute_slots"]) for row in rows] == [
        (callers, threads, slots)
        for callers in (1, 2, 4)
        for threads in (1, 2)
        for slots in (1, 2, 4)
        if slots <= callers
    ]
    best = max((row for row in rows if row["callers"] == 4), key=lambda row: row["photos_per_s"])
    named = f"onnx_threads = {best['onnx_threads']} and compute_slots = {best['compute_slots']}"
    assert shown.json["advice"].startswith(named)
    alone = min((row for row in rows if row["callers"] == 1), key=lambda row: row["p50_ms"])
    assert f"; onnx_threads = {alone['onnx_threads']} answers a single" in shown.json["advice"]


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("--threads", "0"), 2, "--threads takes whole numbers from 1 to 256"),
        (("--threads", "300"), 2, "--threads takes whole numbers from 1 to 256"),
        (("--repeats", "0"), 2, "repeats"),
        (("absent.png",), 2, "no such photo: absent.png"),
        ((__file__,), 1, "test_bench.py: "),
    ],
)
def test_what_cannot_be_timed_is_said(pack, tmp_path, arguments, status, said):
    own = tmp_path / "own.png"
    own.write_bytes(photo(1))
    shown = run(*MODELS, own, *arguments, "--pack", pack)
    assert (shown.status, shown.stdout) == (status, "")
    assert said in shown.stderr
    assert run(*MODELS, own).status == 2
