"""`veilface bench models`. No test judges a time."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest

from api.cli import model_bench
from api.cli.errors import CommandError
from api.cli.model_bench import ModelBench, PhotoRow, advice
from models import sessions
from models.alignment import template
from models.pack import ModelPack
from models.signature import Role
from tests.api.cli.conftest import run
from tests.api.deployment import photo, write_pack
from tests.models.graphs import fixed_face_detector, mean_liveness, pooling_embedder
from tests.models.graphs import write_pack as write_graphs

TIMED = ("bench", "models", "--pack")


@pytest.fixture(autouse=True)
def two_processors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Which rows there are depends on the machine."""
    monkeypatch.setattr("api.cli.bench.processors", lambda: 2)
    monkeypatch.setattr(model_bench, "processors", lambda: 2)


@pytest.fixture
def pack(tmp_path: Path) -> Path:
    return write_pack(tmp_path / "tiny")


def row(callers: int, threads: int, slots: int, rates: list[float], p50s: list[float]) -> PhotoRow:
    return PhotoRow(
        callers,
        threads,
        slots,
        photos_per_s=sorted(rates)[len(rates) // 2],
        p50_ms=sorted(p50s)[len(p50s) // 2],
        cpu_ms=1.0,
        processors_used=1.0,
        photos_per_s_low=min(rates),
        photos_per_s_high=max(rates),
        photos_per_s_repeats=rates,
        p50_ms_repeats=p50s,
    )


DEFAULTS = [
    row(1, 1, 1, [30, 31, 32], [31, 32, 33]),
    row(4, 1, 2, [23, 24, 25], [90, 91, 92]),
]


def test_json_has_every_combination_and_the_advice_its_best_row(pack: Path):
    shown = run(*TIMED, pack, "--repeats", "3", "--json")
    assert shown.status == 0, shown.stderr
    given = shown.json
    assert (given["pack"], given["repeats"], given["providers"]) == ("tiny", 3, ["cpu"])
    assert [
        (g["file"], g["role"], g["onnx_threads"], g["optimisation"]) for g in given["graphs"]
    ] == [
        ("tiny.onnx", "embedder", threads, level)
        for threads in (1, 2)
        for level in ("all", "extended")
    ]
    assert (given["graphs"][0]["wall_ratio"], given["graphs"][0]["cpu_ratio"]) == (1, 1)
    photos = given["photos"]
    assert [(p["callers"], p["onnx_threads"], p["compute_slots"]) for p in photos] == [
        (callers, threads, slots)
        for callers in (1, 2, 4)
        for threads in (1, 2)
        for slots in (1, 2, 4)
        if slots <= callers
    ]
    for each in photos:
        rates = each["photos_per_s_repeats"]
        assert len(rates) == len(each["p50_ms_repeats"]) == 3
        assert [each[f"photos_per_s{end}"] for end in ("_low", "", "_high")] == sorted(rates)
        assert min(each["p50_ms"], each["cpu_ms"], each["processors_used"]) > 0
    best = max((p for p in photos if p["callers"] == 4), key=lambda p: p["photos_per_s"])
    named = f"onnx_threads = {best['onnx_threads']} and compute_slots = {best['compute_slots']}"
    assert given["advice"].startswith(named)
    assert f"({best['photos_per_s']:.1f}" in given["advice"]


def test_the_tables_end_with_the_advice(pack: Path):
    shown = run(*TIMED, pack, "--repeats", "1", "--threads", "1")
    assert shown.status == 0, shown.stderr
    assert "One inference of tiny" in shown.stdout
    assert shown.stdout.count("tiny.onnx") == 2
    assert "soonest" in shown.stdout.splitlines()[-1]


def test_advice_names_what_is_best_at_full_load_and_alone():
    rows = [
        *DEFAULTS,
        row(1, 2, 1, [40, 41, 42], [23, 24, 25]),
        row(4, 1, 4, [30, 31.2, 32], [99, 99, 99]),
        row(4, 2, 1, [26, 27, 28], [10, 10, 10]),
    ]
    assert advice(rows) == (
        "onnx_threads = 1 and compute_slots = 4 answer most photos a second here (31.2; 24.0 with "
        "the defaults); onnx_threads = 2 answers a single photo soonest (24.0 ms; 32.0 ms with the "
        "default)."
    )


def test_advice_says_when_the_defaults_are_best():
    assert advice([*DEFAULTS, row(1, 2, 1, [9], [99]), row(4, 2, 2, [9], [99])]) == (
        "onnx_threads = 1 and compute_slots = 2, the defaults, answer most photos a second here "
        "(24.0); onnx_threads = 1, the default, answers a single photo soonest (32.0 ms)."
    )


def test_advice_says_when_the_best_was_behind_in_a_repeat():
    rows = [*DEFAULTS, row(1, 2, 1, [9] * 3, [31, 20, 21]), row(4, 2, 2, [22, 30, 31], [9] * 3)]
    assert advice(rows).count(", not in every repeat)") == 2


def test_photos_of_ones_own_are_embedded_equally_often(
    pack: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    seen: list[bytes] = []
    monkeypatch.setattr(model_bench, "_embed", lambda _, data: seen.append(data))
    own = {str(number): photo(number) for number in range(3)}
    bench = ModelBench(pack, ("cpu",), (1,), 1, own)
    rounds: list[int] = []
    bench.time_photos(rounds.append)
    bench.time_graphs(rounds.append)
    assert len(rounds) == bench.rounds
    assert {seen.count(data) for data in own.values()} == {len(seen) // 3}


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("--threads", "0"), 2, "--threads takes numbers from 1 to 256, not 0"),
        (("--threads", "two"), 2, "--threads takes whole numbers"),
        (("--threads", "300"), 2, "--threads takes numbers from 1 to 256, not 300"),
        (("--repeats", "0"), 2, "repeats"),
        (("--photo", "absent.png"), 2, "no such photo: absent.png"),
        (("--photo", __file__), 1, "test_model_bench.py: "),
    ],
)
def test_what_cannot_be_timed_is_said(
    pack: Path, arguments: tuple[str, ...], status: int, said: str
):
    shown = run(*TIMED, pack, "--repeats", "1", *arguments)
    assert (shown.status, shown.stdout) == (status, "")
    assert said in shown.stderr


def test_a_pack_is_needed():
    shown = run("bench", "models")
    assert shown.status == 2
    assert "name it with --pack" in shown.stderr


def test_threads_and_optimisation_reach_onnxruntime(pack: Path, monkeypatch: pytest.MonkeyPatch):
    seen = set()
    real = onnxruntime.InferenceSession

    def create(model: bytes, options: onnxruntime.SessionOptions, **rest: Any) -> Any:
        seen.add((options.intra_op_num_threads, options.graph_optimization_level))
        return real(model, options, **rest)

    bench = ModelBench(pack, ("cpu",), (2,), 1, {})
    assert sorted(bench.packs) == [1, 2]
    monkeypatch.setattr(sessions.ort, "InferenceSession", create)
    bench.time_graphs(lambda _: None)
    levels = onnxruntime.GraphOptimizationLevel
    assert seen == set(product((1, 2), (levels.ORT_ENABLE_ALL, levels.ORT_ENABLE_EXTENDED)))


def test_a_pack_of_every_kind_of_graph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_graphs(
        tmp_path / "pack",
        detector=fixed_face_detector((30, 30, 90, 90), template(112)),
        embedder=pooling_embedder(),
        **{"2.7_80x80_MiniFASNetV2": mean_liveness(np.eye(3, dtype=np.float32))},
    )
    bench = ModelBench(tmp_path / "pack", ("cpu",), (1,), 1, {})
    assert [(graph.role, *size) for graph, *size in bench.graphs] == [
        (Role.YUNET, 128, 128),
        (Role.EMBEDDER, 112, 112),
        (Role.LIVENESS, 80, 80),
    ]
    assert len(bench.time_graphs(lambda _: None)) == 2 * 3
    assert len(bench.time_photos(lambda _: None)) == 6
    monkeypatch.setattr(ModelPack, "detect", lambda *_: [])
    with pytest.raises(CommandError, match="sees no face in drawn photos; name others"):
        bench.time_photos(lambda _: None)


@pytest.mark.long
def test_drawn_photos_are_faces_to_real_detectors(mbf_pack_dir: Path, yunet_pack_dir: Path):
    for folder in (mbf_pack_dir, yunet_pack_dir):
        shown = run(*TIMED, folder, "--threads", "1", "--repeats", "1", "--json")
        assert shown.status == 0, shown.stderr
        assert len(shown.json["graphs"]) == 4
