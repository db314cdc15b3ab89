"""`veilface bench distances`. No test judges a time."""

import os
import statistics
import sys

import pytest

from api.cli import bench, distance_bench
from templates.distances import DEFAULT_STEPS
from tests.api.cli.conftest import run

TINY = ("bench", "distances", "--count", "9", "--n", "12,24", "--dim", "2,3", "--repeats", "3")


@pytest.fixture(autouse=True)
def no_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing here depends on what a time is."""
    monkeypatch.setattr(distance_bench, "_REST", 0)


def test_json_holds_every_combination_and_every_time():
    shown = run(*TINY, "--threads", "1", "--seed", "7", "--json")
    assert shown.status == 0
    given = shown.json
    assert {key: given[key] for key in ("count", "repeats", "steps", "dtype", "seed")} == {
        "count": 9,
        "repeats": 3,
        "steps": DEFAULT_STEPS,
        "dtype": "float32",
        "seed": 7,
    }
    assert given["machine"]["threads"] == 1
    assert given["machine"]["processors"] >= 1
    assert given["machine"]["device"] is None
    assert [(row["n"], row["m"], row["mode"], row["metric"]) for row in given["rows"]] == [
        (n, m, mode, metric)
        for n in (12, 24)
        for m in (2, 3)
        for mode in ("p2s", "s2s")
        for metric in ("euclidean", "spherical")
    ]


def test_ratios_follow_from_the_times():
    for row in run(*TINY, "--json").json["rows"]:
        repeats = row["repeats"]
        assert len(repeats) == 3
        for name in ("product_ms", "distances_ms", "authors_ms"):
            assert min(repeat[name] for repeat in repeats) > 0
            assert row[name] == statistics.median(repeat[name] for repeat in repeats)
        to_product = [repeat["distances_ms"] / repeat["product_ms"] for repeat in repeats]
        authors = [repeat["authors_ms"] / repeat["distances_ms"] for repeat in repeats]
        assert row["ratio_to_product"] == pytest.approx(statistics.median(to_product))
        assert row["ratio_to_product_low"] == pytest.approx(min(to_product))
        assert row["ratio_to_product_high"] == pytest.approx(max(to_product))
        assert row["authors_to_distances"] == pytest.approx(statistics.median(authors))


def test_the_table_has_what_was_asked_for():
    shown = run(*TINY, "--mode", "s2s", "--metric", "spherical", "--threads", "1")
    assert shown.status == 0
    assert "9 × 9 distances in float32" in shown.stdout
    assert "× product" in shown.stdout
    assert shown.stdout.count("spherical") == shown.stdout.count("s2s") == 4
    assert "euclidean" not in shown.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--mode", "p2p"), "--mode takes p2s or s2s, not 'p2p'"),
        (("--metric", "cosine"), "--metric takes euclidean or spherical, not 'cosine'"),
        (("--dim", "2,24"), "--dim 24 does not fit --n 12"),
        (("--dim", "0"), "--dim takes numbers from 1, not 0"),
        (("--dim", "few"), "--dim takes whole numbers such as 8,16, not 'few'"),
        (("--n", "1"), "--n takes numbers from 2, not 1"),
        (("--device", "cpu", "--threads", "2"), "leave it out with --device"),
        (("--repeats", "0"), "repeats"),
    ],
)
def test_wrong_usage_says_what_is_taken(arguments: tuple[str, ...], said: str):
    shown = run(*TINY, *arguments)
    assert shown.status == 2
    assert said in shown.stderr
    assert not shown.stdout


@pytest.mark.parametrize("device", ["cuda:99", "nonsense", "meta"])
def test_a_device_that_is_not_there_is_refused(device: str):
    pytest.importorskip("torch")
    shown = run(*TINY, "--device", device)
    assert shown.status == 2
    assert f"torch cannot use the device {device}: " in shown.stderr
    assert "leave out --device" in shown.stderr


def test_a_device_without_torch_names_the_extra(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "templates.distances.torch", raising=False)
    monkeypatch.delattr("templates.distances.torch", raising=False)
    shown = run(*TINY, "--device", "cuda")
    assert shown.status == 2
    assert 'pip install "veilface[torch]"' in shown.stderr


def test_a_device_is_measured_with_torch():
    pytest.importorskip("torch")
    shown = run(*TINY, "--device", "cpu", "--metric", "euclidean", "--json")
    assert shown.status == 0
    assert shown.json["machine"]["device"] == "cpu"
    assert len(shown.json["rows"]) == 8


def test_what_does_not_fit_into_memory_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bench, "memory_needed", lambda question: 1 << 60)
    shown = run(*TINY)
    if hasattr(os, "sysconf"):
        assert shown.status == 2
        assert "GiB, and this machine has" in shown.stderr
        assert "smaller --count" in shown.stderr


def test_memory_that_runs_out_is_no_defect(monkeypatch: pytest.MonkeyPatch):
    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(bench, "measure", exhausted)
    shown = run(*TINY)
    assert shown.status == 1
    assert "error: not enough memory" in shown.stderr
