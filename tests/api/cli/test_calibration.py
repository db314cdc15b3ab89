"""The verdict of a calibration in words."""

from dataclasses import replace

import pytest

from api.cli.verdict import plain_lines, verdict_lines
from templates.contract.levels import Rate
from templates.contract.verdict import Judgement, Verdict


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


def test_the_worst_group_and_what_was_not_counted_are_named() -> None:
    basis = {**PHOTOS, "photos": 2000, "photos_not_acquired": 7}
    group = {"attribute": "race", "group": "x", "level": "fmr-1e-2", "groups_from": "a label file"}
    bad = judged(80, 400)
    verdict = Verdict(
        bad, replace(bad, basis=basis), replace(bad, basis={**group, "probe_photos": 1})
    )
    _, accuracy, last = verdict_lines(verdict)
    assert accuracy.endswith(" Not counted: 7 of 2,000 photos without a usable face.")
    assert last.startswith("Groups: FAIL. Worst is race x: 20 % (80")
