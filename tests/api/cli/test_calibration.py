"""Axes and dimension that a calibration takes, and faces of which nobody knows who they are."""

from pathlib import Path

import numpy as np
import pytest

from api.cli.calibration import operating_point
from api.cli.verdict import verdict_lines
from models.extraction import Extraction
from templates.contract.verdict import Verdict
from templates.space.lifting import Strategy
from tests.verify.population import N, decoys, photos_of, unit
from verify import CalibrationOptions
from verify.preparation import without_lookalikes


@pytest.mark.parametrize("asked", [None, 8])
def test_so_few_people_show_nothing_of_any_dimension(asked: int | None) -> None:
    point = operating_point(
        photos_of(30, 2, seed=4).reshape(-1, N),
        [str(number // 2) for number in range(60)],
        decoys(),
        strategy=Strategy.ADVERSARIAL,
        axes=None,
        m=asked,
        options=CalibrationOptions(),
        progress=lambda _what, _share: None,
    )
    assert asked in (None, point.dim)
    assert (point.axes, point.dim) in [(one.axes, one.m) for one in point.tried]
    assert point.privacy.status == "NOT SHOWN"
    (said, accuracy, _) = verdict_lines(Verdict(point.privacy))
    assert said.startswith("Privacy:  NOT SHOWN. ")
    assert "Not enough to pass: 15 people are too few to choose by" in said
    assert accuracy == "Accuracy: not measured: nobody has two photos."


def test_of_faces_that_look_alike_the_first_stays() -> None:
    rows = unit(np.random.default_rng(8).normal(size=(4, N)))
    rows[2] = unit(rows[0] + 0.5 * rows[3])
    paths = [Path(f"{number}.jpg") for number in range(4)]
    kept = without_lookalikes(Extraction(rows, paths, [], cached=0))
    assert [path.name for path in kept.paths] == ["0.jpg", "1.jpg", "3.jpg"]
    np.testing.assert_array_equal(kept.descriptors, rows[[0, 1, 3]])


def test_copies_among_thousands_are_dropped() -> None:
    rows = unit(np.random.default_rng(9).normal(size=(5_000, 128)))
    rows[7], rows[4_999] = rows[3], rows[2_500]
    paths = [Path(f"{number}.jpg") for number in range(len(rows))]
    kept = without_lookalikes(Extraction(rows, paths, [], cached=0))
    assert {int(path.stem) for path in kept.paths} == set(range(5_000)) - {7, 4_999}
