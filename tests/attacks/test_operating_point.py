"""The smallest dimension that is private, found with few measurements; what shows too little."""

import dataclasses

import pytest

from attacks.operating_point import (
    DIMS,
    judge_accuracy,
    judge_groups,
    judge_privacy,
    smallest_private,
)
from attacks.privacy import Privacy, Theft
from templates.contract.levels import GroupRates, Level, Rate
from templates.contract.verdict import Judgement
from templates.space.lifting import Strategy
from tests.templates.contract.test_contract import LIFTED, make_calibration, make_contract


@pytest.mark.parametrize("smallest", [*DIMS, None])
def test_the_smallest_that_passes_is_found(smallest: int | None) -> None:
    asked: list[int] = []

    def judge(dim: int) -> Judgement:
        asked.append(dim)
        failing = smallest is None or dim < smallest
        return Judgement(Rate(50 if failing else 5, 400, 0.0, 1.0), 0.05)

    point = smallest_private(judge, DIMS, otherwise=64)
    assert point.dim == (smallest or 64)
    assert (point.tried[point.dim].status == "PASS") == (smallest is not None)
    assert list(point.tried) == sorted(set(asked))
    assert len(asked) == len(set(asked)) <= 4
    assert point.dim in point.tried


def test_no_dimension_to_try_measures_the_one_that_is_taken() -> None:
    judgement = Judgement(Rate(0, 10, 0.0, 0.3), 0.05)
    point = smallest_private(lambda _dim: judgement, (), otherwise=8)
    assert (point.dim, point.tried) == (8, {8: judgement})


@pytest.mark.parametrize(
    ("people", "faces", "uncovered", "status"),
    [
        (100, 1000, None, "PASS"),
        (99, 1000, None, "FAIL"),
        (100, 999, None, "FAIL"),
        (300, 5000, "who has the pool finds the decoys", "FAIL"),
    ],
)
def test_what_shows_too_little_does_not_pass(
    people: int, faces: int, uncovered: str | None, status: str
) -> None:
    rate = Rate(0, people, 0.0, 1.0)
    thefts = (Theft("foot point", 0, rate, rate), Theft("second moments", faces, rate, rate))
    privacy = Privacy(Strategy.ADVERSARIAL, 64, thefts, None)
    judgement = judge_privacy(privacy, uncovered=uncovered)
    assert judgement.status == status
    assert (judgement.shortfall is None) == (status == "PASS")
    assert Judgement.from_json(judgement.to_json()) == judgement


def groups_of(*errors: int, judged: bool = True, trials: int = 1000) -> tuple[GroupRates, ...]:
    rates = [Rate(count, trials, 0.0, 1.0) for count in errors]
    return tuple(
        GroupRates("kind", f"g{i}", rate, rate, judged, True) for i, rate in enumerate(rates)
    )


def level_of(*groups: GroupRates, name: str = "fmr-1e-2", target: float = 1e-2) -> Level:
    rate = Rate(10, 1000, 0.0, 1.0)
    return Level(name, target, 2.0, rate, rate, groups=groups)


def test_the_worst_group_of_the_default_level_is_judged() -> None:
    stricter = level_of(*groups_of(900), name="fmr-1e-3", target=1e-3)
    contract = make_contract(
        calibrations=(
            make_calibration(levels=(level_of(*groups_of(3, 20)), stricter)),
            make_calibration(
                levels=(level_of(*groups_of(21, 4), *groups_of(*[999] * 3, judged=False)[2:]),),
                probe_photos=3,
            ),
            make_calibration(**LIFTED, levels=(level_of(),)),
        ),
    )
    judgement = judge_groups(contract)
    assert judgement is not None
    assert (judgement.status, judgement.rate.errors, judgement.limit) == ("FAIL", 21, 0.02)
    assert (judgement.basis["group"], judgement.basis["probe_photos"]) == ("g0", 3)
    assert Judgement.from_json(judgement.to_json()) == judgement


def test_a_worst_group_at_twice_the_target_passes_and_one_that_is_small_is_not_judged() -> None:
    at_limit = make_contract(calibrations=(make_calibration(levels=(level_of(*groups_of(20)),)),))
    judgement = judge_groups(at_limit)
    assert judgement is not None
    assert judgement.status == "PASS"
    small = level_of(*groups_of(20, judged=False))
    assert judge_groups(make_contract(calibrations=(make_calibration(levels=(small,)),))) is None
    assert judge_groups(make_contract()) is None


@pytest.mark.parametrize("enrolled", [3, 5])
def test_accuracy_counts_probes_that_are_refused(enrolled: int) -> None:
    """Of 1,000 probes 15 do not match, which passes; 10 more of 1,010 are refused."""
    few, many = Rate(15, 1000, 0.0, 1.0), Rate(25, 1010, 0.0, 1.0)
    level = Level("fmr-1e-3", 1e-3, 2.0, few, few, fnmr_by_photos={enrolled: few})
    for refused, status in (({}, "PASS"), ({enrolled: many}, "FAIL")):
        counted = dataclasses.replace(level, frr_by_photos=refused)
        judgement = judge_accuracy(
            make_contract(
                calibrations=(make_calibration(levels=(counted,), probe_photos=3),),
                default_level="fmr-1e-3",
            ),
            photos=2000,
            not_acquired=7,
        )
        assert judgement.status == status
        assert judgement.basis["photos_not_acquired"] == 7
        assert judgement.basis["enrolled_photos"] == enrolled
