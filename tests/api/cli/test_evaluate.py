"""`veilface evaluate` end to end on drawn faces and the demo model."""

import csv
import io
import json
import os
import pickle
import shutil
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from models.demo import DEMO_NOTICE
from templates.space.subspace import SubspaceBatch
from tests.api.cli.conftest import run
from tests.api.cli.evaluation_bench import (
    CONTRACT,
    FILES,
    PAIRS,
    STRATEGIES,
    embedded,
    pairs_of,
    secret_bytes,
    secrets,
)
from verify.evaluation import comparison


def test_everything_is_written(bench, results):
    out = bench.root / "out"
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert bench.first.json["files"] == FILES
    for name in ("figure", "det"):
        with Image.open(out / f"{name}.png") as picture:
            assert min(picture.size) > 300
            assert len(set(np.asarray(picture.convert("L")).ravel().tolist())) > 10
        assert ET.parse(out / f"{name}.svg").getroot().tag.endswith("svg")
    lines = list(csv.DictReader(io.StringIO((out / "results.csv").read_text(encoding="utf-8"))))
    assert len(lines) == len(results["rows"])
    for line, row in zip(lines, results["rows"], strict=True):
        assert line["strategy"] == row["strategy"]
        assert float(line["accuracy_mean"]) == row["accuracy_mean"]
        assert float(line["fnmr_at_fmr_0.2_ci_high"]) == row["fnmr_at_fmr"]["0.2"]["ci_high"]
    report = (out / "results.md").read_text(encoding="utf-8")
    raw = next(row for row in results["rows"] if row["strategy"] == "raw")
    assert f"{100 * raw['accuracy_mean']:.2f} ± {100 * raw['accuracy_std']:.2f}" in report
    assert "Failures to acquire: none." in report


def test_only_json_is_on_stdout_and_it_is_the_document(bench, results):
    said = bench.first.json
    assert said.pop("notice") == DEMO_NOTICE
    assert said.pop("out") == str(bench.root / "out")
    assert said.pop("files") == FILES
    assert said == results
    assert f"note: {DEMO_NOTICE}" in bench.first.stderr


def test_every_row_has_the_fields_of_the_contract(results):
    for row in results["rows"]:
        assert row.keys() >= CONTRACT
        assert (row["dataset"], row["seed"]) == ("lfw", 7)
        assert row["n_genuine"] == row["n_impostor"] == PAIRS // 2
        assert 0.5 <= row["accuracy_mean"] <= 1
        assert set(row["fnmr_at_fmr"]) == {"0.2"}
        at = row["fnmr_at_fmr"]["0.2"]
        assert 0 <= at["ci_low"] <= at["value"] <= at["ci_high"] <= 1
        assert at["ci_high"] > 0.1  # 30 trials say little, with no error too
        assert at["fmr"] <= 0.2
    (refused,) = results["refused"]
    assert "FMR 0.001 is not reported" in refused
    seeds = {each["seed"] for each in results["runs"]}
    assert seeds == {None, 7, 8}


def test_rows_are_what_was_asked_for(results):
    kinds = [None, "generator", "pool"]
    expected = [("raw", None, 0, "p2p", "euclidean", search) for search in ("grid", "exact")]
    for mode in ("p2s", "s2s"):
        for strategy, decoys in (
            ("random", kinds[:1]),
            ("adversarial", kinds[1:]),
            ("hybrid+", kinds[2:]),
        ):
            expected += [
                (strategy, kind, 2, mode, metric, "exact")
                for kind in decoys
                for metric in ("euclidean", "spherical")
            ]
    keys = ("strategy", "decoys", "dim", "mode", "metric", "threshold_search")
    assert [tuple(row[key] for key in keys) for row in results["rows"]] == expected


def test_no_face_is_left_in_what_was_written(bench, tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    monkeypatch.setattr(tempfile, "tempdir", None)
    lifted: list[SubspaceBatch] = []
    plain = comparison.lift

    def recorded(*given: Any, **named: Any) -> SubspaceBatch:
        lifted.append(plain(*given, **named))
        return lifted[-1]

    monkeypatch.setattr(comparison, "lift", recorded)
    out = tmp_path / "out"
    ran = run(*bench.full, "--repeats", "1", "--out", out)
    assert ran.status == 0, ran.stderr
    assert list(temporary.iterdir()) == []
    written = [file.read_bytes() for file in out.rglob("*") if file.is_file()]
    assert len(written) == len(FILES)
    needles = secrets(bench) + secret_bytes(
        row for batch in lifted for row in (*batch.feet, *batch.bases[:, 0])
    )
    assert len(needles) > 4 * 2 * PAIRS
    whole = b"\n".join(written)
    assert not [needle for needle in needles if needle in whole]


def test_descriptors_from_a_file_give_the_rows_of_the_pack(bench, results, tmp_path):
    known = embedded(bench)
    paths = np.array([file.relative_to(bench.lfw).as_posix() for file in known])
    np.savez(tmp_path / "own.npz", paths=paths, descriptors=np.stack(list(known.values())))
    ran = run(
        *("evaluate", bench.lfw, "--pack", "none", "--embeddings", tmp_path / "own.npz"),
        *(*bench.decoys, *bench.plan, "--strategy", ",".join(STRATEGIES), "--labels", bench.labels),
        *("--data-dir", bench.root / "data", "--jobs", "1", "--out", tmp_path / "out", "--json"),
    )
    assert ran.status == 0, ran.stderr
    assert "notice" not in ran.json
    assert ran.json["model"]["embeddings"] == "own.npz"
    for theirs, mine in zip(ran.json["rows"], results["rows"], strict=True):
        wanted = dict(mine)
        for key in ("auc", "threshold_mean"):
            assert theirs.pop(key) == pytest.approx(wanted.pop(key), abs=1e-5)
        for row in (theirs, wanted):
            row["fnmr_at_fmr"] = {
                target: {key: value for key, value in at.items() if key != "threshold_mean"}
                for target, at in row["fnmr_at_fmr"].items()
            }
        assert theirs == wanted


class Hostile:
    """Creates a file when it is unpickled by Python's own unpickler."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> Any:
        return os.system, (f"touch '{self.marker}'",)


def test_a_hostile_bin_is_refused_and_nothing_runs(bench, tmp_path):
    marker = tmp_path / "marker"
    data = pickle.dumps(Hostile(marker))
    pickle.loads(data)
    assert marker.exists()  # the file does what it is made for
    marker.unlink()
    file = tmp_path / "bad.bin"
    file.write_bytes(data)
    ran = run("evaluate", file, *bench.base, "--out", tmp_path / "out")
    assert (ran.status, ran.stdout) == (1, "")
    assert ran.stderr.startswith(f"error: {file} ")
    assert "Traceback" not in ran.stderr
    assert not marker.exists()
    assert not (tmp_path / "out").exists()


def test_a_photo_without_a_face_is_a_failure_to_acquire(bench, tmp_path):
    folder = tmp_path / "lfw"
    shutil.copytree(bench.lfw, folder)
    broken = pairs_of(folder)[0][0]
    broken.write_bytes(b"not a photo")
    pairs = [(broken in (a, b), same) for a, b, same in pairs_of(folder)]
    lost = [sum(hit and same is kind for hit, same in pairs) for kind in (True, False)]
    ran = run(
        *("evaluate", folder, *bench.base, "--strategy", "raw", "--fmr", "0.2"),
        *("--out", tmp_path / "out"),
    )
    assert ran.status == 0, ran.stderr
    images = len({photo for a, b, _ in pairs_of(folder) for photo in (a, b)})
    assert f"note: lfw: 1 of {images} photos skipped" in ran.stderr
    assert DEMO_NOTICE in ran.stderr
    assert "lfw: " in ran.stdout
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    (dataset,) = written["datasets"]
    (failure,) = dataset["failures"]
    name = broken.relative_to(folder).as_posix()
    assert (failure["image"], failure["code"]) == (name, "unsupported_image")
    assert dataset["fta"] == 1 / images
    for row in written["rows"]:
        assert [row["failed_genuine"], row["failed_impostor"]] == lost
        assert [row["n_genuine"], row["n_impostor"]] == [PAIRS // 2 - count for count in lost]
    assert name in (tmp_path / "out" / "results.md").read_text()
