"""`veilface bench`: what it times, not how long that takes."""

from pathlib import Path

import numpy as np
import pytest

from api.cli import bench_distances
from api.cli.bench_distances import authors_distances, face_like, face_like_templates
from api.cli.bench_models import Row, advice
from models.pack import ModelPack
from templates.distances import pairwise_distances
from templates.keys.randomness import Keystream
from tests.api.cli.conftest import run
from tests.api.deployment import photo, write_pack

DISTANCES = ("bench", "distances", "--count", "9", "--n", "12,24", "--dim", "2,3", "--repeats", "3")
MODELS = ("bench", "models", "--pack")


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
        assert min(row["product_ms"], row["distances_ms"], row["authors_ms"]) > 0
        low, high = row["ratio_to_product_low"], row["ratio_to_product_high"]
        assert low <= row["ratio_to_product"] <= high
    assert run(*DISTANCES).stdout.count("s2s") == 8


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--dim", "2,24"), "--dim takes dimensions from 1 to 11, not 24"),
        (("--dim", "few"), "--dim takes whole numbers such as 8,16, not 'few'"),
        (("--n", "1"), "--n takes numbers from 2, not 1"),
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
    assert shown.status == 2
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
    timed = (*MODELS, pack, "--repeats", "2", "--photo", own, "--threads", "2")
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
    text = run(*MODELS, pack, "--repeats", "1", "--threads", "1").stdout
    assert "Whole photos, tiny" in text
    assert "soonest" in text.splitlines()[-1]


def test_advice_names_what_is_best_at_full_load_and_alone():
    rows = [
        Row(callers, threads, slots, rate, p50, 1.0)
        for callers, threads, slots, rate, p50 in [
            (1, 1, 1, 31.0, 32.0), (4, 1, 2, 24.0, 91.0), (1, 2, 1, 41.0, 24.0),
            (4, 1, 4, 31.2, 99.0), (4, 2, 1, 27.0, 10.0),
        ]
    ]  # fmt: skip
    assert advice(rows, here=2) == (
        "onnx_threads = 1 and compute_slots = 4 answer most photos a second here (31.2; 24.0 with "
        "the defaults); onnx_threads = 2 answers a single photo soonest (24.0 ms; 32.0 ms with the "
        "default)."
    )


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("--threads", "0"), 2, "--threads takes numbers from 1 to 256, not 0"),
        (("--threads", "two"), 2, "--threads takes whole numbers"),
        (("--threads", "300"), 2, "--threads takes numbers from 1 to 256, not 300"),
        (("--repeats", "0"), 2, "repeats"),
        (("--photo", "absent.png"), 2, "no such photo: absent.png"),
        (("--photo", __file__), 1, "test_bench.py: "),
    ],
)
def test_what_cannot_be_timed_is_said(pack, arguments, status, said):
    shown = run(*MODELS, pack, "--repeats", "1", *arguments)
    assert (shown.status, shown.stdout) == (status, "")
    assert said in shown.stderr


def test_a_pack_is_needed_that_sees_faces(mbf_pack_dir, monkeypatch):
    assert run("bench", "models").status == 2
    monkeypatch.setattr(ModelPack, "detect", lambda *_: [])
    shown = run(*MODELS, mbf_pack_dir, "--repeats", "1")
    assert shown.status == 1
    assert "sees no face in drawn photos; name others" in shown.stderr
