import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from templates.decoys import Attributes
from templates.distances import Metric
from templates.space.lifting import Strategy
from tests.verify.evaluation.materials import material
from verify.evaluation.baselines import Hash
from verify.evaluation.checkpoints import FOLDER, Checkpoints
from verify.evaluation.runs import Run, run_unit
from verify.evaluation.units import HashUnit, LiftUnit, Mode, RawUnit, Unit

BASE: dict[str, Any] = {"pictures": "ab", "pairs": "cd", "model": {"n": 24}, "software": "0.1.0"}
PAIRS = 100
LIFTED = LiftUnit(
    strategy=Strategy.RANDOM,
    m=2,
    source=None,
    shared=False,
    modes=(Mode.POINT, Mode.SUBSPACE),
    metrics=(Metric.EUCLIDEAN,),
    steps=5,
    seed=3,
)


def kept(folder: Path, unit: Unit = LIFTED, **depends: Any) -> list[Run]:
    known = material(pairs=PAIRS)
    runs = run_unit(replace(known, flipped=known.descriptors), unit, targets=(0.1,))
    Checkpoints(folder, BASE, **depends).save(unit, runs)
    return runs


@pytest.mark.parametrize(
    ("unit", "columns"),
    [(RawUnit(flip=False), 1), (LIFTED, 3), (HashUnit(Hash.BIOHASHING, 24, False, 3), 1)],
)
def test_similarities_come_back_as_they_were(tmp_path: Path, unit: Unit, columns: int) -> None:
    runs = kept(tmp_path, unit)
    found = Checkpoints(tmp_path, BASE).load(unit, columns=columns, pairs=PAIRS)
    assert found is not None
    exact = [run.similarities for run in runs if run.search == "exact"]
    assert len(found) == len(exact) == columns
    for column, wanted in zip(found, exact, strict=True):
        np.testing.assert_array_equal(column, wanted)


@pytest.mark.parametrize(
    "change",
    [
        {"pictures": "ac"},
        {"pairs": "ce"},
        {"model": {"n": 25}},
        {"software": "0.1.1"},
        {"sources": ["one more"]},
    ],
)
def test_a_unit_of_another_base_is_not_found(tmp_path: Path, change: dict[str, Any]) -> None:
    kept(tmp_path)
    assert Checkpoints(tmp_path, BASE).load(LIFTED, columns=3, pairs=PAIRS) is not None
    assert Checkpoints(tmp_path, BASE | change).load(LIFTED, columns=3, pairs=PAIRS) is None


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 4},
        {"m": 3},
        {"steps": 6},
        {"shared": True},
        {"source": 0},
        {"strategy": Strategy.HYBRID},
        {"metrics": (Metric.SPHERICAL,)},
        {"modes": (Mode.SUBSPACE, Mode.POINT)},
    ],
)
def test_another_unit_is_not_found(tmp_path: Path, change: dict[str, Any]) -> None:
    kept(tmp_path)
    saved = Checkpoints(tmp_path, BASE, sources=["a"])
    assert saved.load(replace(LIFTED, **change), columns=3, pairs=PAIRS) is None


def test_a_unit_depends_on_its_own_decoys_only(tmp_path: Path) -> None:
    unit = replace(LIFTED, source=0)
    kept(tmp_path, unit, sources=["a"])
    for sources, place, found in ((["a", "b"], 0, True), (["b", "a"], 1, True), (["b"], 0, False)):
        saved = Checkpoints(tmp_path, BASE, sources=sources)
        loaded = saved.load(replace(unit, source=place), columns=3, pairs=PAIRS)
        assert (loaded is not None) is found


def test_attributes_and_mirror_images_concern_their_own_units(tmp_path: Path) -> None:
    labels = [Attributes("Male", "White")]
    mirrored = np.eye(2, dtype=np.float32)
    plus = replace(LIFTED, strategy=Strategy.HYBRID_PLUS, source=0)
    kept(tmp_path)
    kept(tmp_path, plus, sources=["a"], attributes=labels)
    kept(tmp_path, RawUnit(flip=False))
    kept(tmp_path, RawUnit(flip=True), flipped=mirrored)
    saved = Checkpoints(tmp_path, BASE, sources=["a"], flipped=2 * mirrored)
    assert saved.load(LIFTED, columns=3, pairs=PAIRS) is not None
    assert saved.load(RawUnit(flip=False), columns=1, pairs=PAIRS) is not None
    assert saved.load(RawUnit(flip=True), columns=1, pairs=PAIRS) is None
    assert saved.load(plus, columns=3, pairs=PAIRS) is None
    again = Checkpoints(tmp_path, BASE, sources=["a"], attributes=labels)
    assert again.load(plus, columns=3, pairs=PAIRS) is not None


def test_units_of_different_kinds_do_not_meet(tmp_path: Path) -> None:
    kept(tmp_path, RawUnit(flip=False))
    saved = Checkpoints(tmp_path, BASE)
    assert saved.load(RawUnit(flip=True), columns=1, pairs=PAIRS) is None
    kept(tmp_path, HashUnit(Hash.BIOHASHING, 24, False, 3))
    for other in (
        HashUnit(Hash.BIOHASHING, 24, True, 3),
        HashUnit(Hash.MLP_HASH, 24, False, 3),
        HashUnit(Hash.BIOHASHING, 24, False, 4),
    ):
        assert saved.load(other, columns=1, pairs=PAIRS) is None


def test_columns_that_do_not_fit_are_ignored(tmp_path: Path) -> None:
    kept(tmp_path)
    saved = Checkpoints(tmp_path, BASE)
    assert saved.load(LIFTED, columns=4, pairs=PAIRS) is None
    assert saved.load(LIFTED, columns=3, pairs=PAIRS - 1) is None
    (file,) = (tmp_path / FOLDER).iterdir()
    with np.load(file) as held:
        columns = {name: column.astype(np.float32) for name, column in held.items()}
    np.savez(file, allow_pickle=False, **columns)
    assert saved.load(LIFTED, columns=3, pairs=PAIRS) is None


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text", "pickle", "folder"])
def test_a_damaged_file_is_ignored_and_replaced(tmp_path: Path, damage: str) -> None:
    runs = kept(tmp_path)
    saved = Checkpoints(tmp_path, BASE)
    (file,) = (tmp_path / FOLDER).iterdir()
    whole = file.read_bytes()
    place = whole.index(runs[0].similarities[:4].tobytes())
    match damage:
        case "empty":
            file.write_bytes(b"")
        case "cut":
            file.write_bytes(whole[: len(whole) // 2])
        case "flipped":
            file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        case "text":
            file.write_text("not an archive")
        case "pickle":
            objects = np.array([{"a": 1}] * PAIRS, dtype=object)
            np.savez(file, column_0=objects, column_1=objects, column_2=objects)
        case "folder":
            file.unlink()
            file.mkdir()
    assert saved.load(LIFTED, columns=3, pairs=PAIRS) is None
    if damage != "folder":
        saved.save(LIFTED, runs)
        assert saved.load(LIFTED, columns=3, pairs=PAIRS) is not None
        assert [each.suffix for each in (tmp_path / FOLDER).iterdir()] == [".npz"]


def test_a_write_that_fails_leaves_no_part_and_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = kept(tmp_path)
    (file,) = (tmp_path / FOLDER).iterdir()
    before = file.read_bytes()

    def broken(stream: Any, **columns: Any) -> None:
        stream.write(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", broken)
    with contextlib.suppress(OSError):
        Checkpoints(tmp_path, BASE).save(LIFTED, runs)
    assert list((tmp_path / FOLDER).iterdir()) == [file]
    assert file.read_bytes() == before
