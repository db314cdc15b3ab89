"""Axes and dimension that a calibration takes, and faces of which nobody knows who they are."""

from pathlib import Path

import numpy as np
import pytest

from api.cli.calibration import operating_point
from api.cli.verdict import plain_lines, verdict_lines
from models.extraction import Extraction
from templates.contract.levels import Rate
from templates.contract.verdict import Judgement, Verdict
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
    assert said.startswith("Privacy: not proven. ")
    assert "This is not enough to prove it: 15 people are too few to choose by" in said
    assert accuracy.startswith("Accuracy: not measured: nobody is labelled with two photos.")


def judged(errors: int, trials: int, *, shortfall: str | None = None, **basis: int) -> Judgement:
    value = errors / trials
    rate = Rate(errors=errors, trials=trials, ci_low=value, ci_high=value)
    bound = None if basis else 0.1
    return Judgement(rate, 0.05, basis, shortfall=shortfall, bound=bound)


PHOTOS = {"enrolled_photos": 3, "probe_photos": 2}
ELSEWHERE = "people could be recognised elsewhere"


@pytest.mark.parametrize(
    ("privacy", "accuracy", "said"),
    [
        (
            judged(43, 600),
            judged(10, 500, **PHOTOS),
            [
                "Privacy: not proven. If the database and the master key are both stolen, about "
                f"1 in 14 {ELSEWHERE} (43 of 600).",
                "It is lower with 600 photos or more of people like yours",
                "Accuracy: 1 in 50 genuine attempts failed (10 of 500), with 3 photos enrolled and "
                "2 shown.",
            ],
        ),
        (
            judged(270, 300),
            judged(0, 90, shortfall="90 genuine probes are too few", **PHOTOS),
            [
                f"about 9 in 10 {ELSEWHERE}",
                "Accuracy: none of the genuine attempts failed (0 of 90)",
                "Few were measured: 90 genuine probes are too few.",
            ],
        ),
        (
            judged(2, 15, shortfall="15 people are too few"),
            None,
            [
                f"about 1 in 8 {ELSEWHERE} (2 of 15). This is not enough to prove it: 15 people "
                "are too few. It is lower",
                "Accuracy: not measured: nobody",
            ],
        ),
        (judged(100, 400), judged(45, 90, **PHOTOS), ["about 3 in 10", "5 in 10 genuine"]),
        (judged(160, 400), judged(22, 90, **PHOTOS), ["about 4 in 10", "1 in 4 genuine"]),
        (judged(0, 300), None, ["Privacy: proven", "none of the 300 people attacked could be"]),
    ],
)
def test_the_verdict_in_words_for_everybody(
    privacy: Judgement, accuracy: Judgement | None, said: list[str]
) -> None:
    lines = "\n".join(plain_lines(Verdict(privacy, accuracy)))
    assert all(part in lines for part in said), lines
    assert ("It is lower" in lines) == (privacy.status != "PASS")
    assert "LFW's people" not in lines
    line = plain_lines(Verdict(privacy), strangers=True)[0]
    assert "1 in 7 to 1 in 12" in line
    of_whom = " for people like those of --faces"
    assert (of_whom in line) == (privacy.status == "PASS")


def test_of_faces_that_look_alike_the_first_stays() -> None:
    rows = unit(np.random.default_rng(8).normal(size=(4, N)))
    rows[2] = unit(rows[0] + 0.5 * rows[3])
    paths = [Path(f"{number}.jpg") for number in range(4)]
    kept = without_lookalikes(Extraction(rows, paths, [], cached=0))
    assert [path.name for path in kept.paths] == ["0.jpg", "1.jpg", "3.jpg"]
    np.testing.assert_array_equal(kept.embeddings, rows[[0, 1, 3]])


def test_copies_among_thousands_are_dropped() -> None:
    rows = unit(np.random.default_rng(9).normal(size=(5_000, 128)))
    rows[7], rows[4_999] = rows[3], rows[2_500]
    paths = [Path(f"{number}.jpg") for number in range(len(rows))]
    kept = without_lookalikes(Extraction(rows, paths, [], cached=0))
    assert {int(path.stem) for path in kept.paths} == set(range(5_000)) - {7, 4_999}
