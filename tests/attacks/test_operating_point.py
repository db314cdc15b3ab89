"""The pair that is private and cheap; what shows too little; accuracy and groups."""

import dataclasses

import numpy as np
import pytest

from attacks.attack import Guesses
from attacks.bed import LEAST_VICTIMS
from attacks.operating_point import (
    AIM,
    MOST_BYTES,
    axes_to_try,
    choose,
    choose_and_judge,
    dims_to_try,
    judge_accuracy,
    judge_groups,
    judge_privacy,
)
from attacks.recovery import Recovery
from attacks.setup import AttackSetup
from templates.contract.levels import GroupRates, Level, Rate
from templates.contract.verdict import Judgement
from templates.space.lifting import Strategy
from tests.attacks.kinds import FACES, OTHER, generator, rows
from tests.templates.contract.test_contract import LIFTED, make_calibration, make_contract
from tests.verify.synthetic import make_pool, unit


def people(count: int, kind: np.ndarray, *, photos: int = 2, own: float = 0.3) -> AttackSetup:
    """Photos of people, and a generator of a kind; ``own``: how much photos of one differ."""
    centres = rows(count, FACES, 1)
    owner = np.repeat(np.arange(count), photos)
    shown = unit(centres[owner] + own * rows(len(owner), FACES, 2)).astype(np.float32)
    names = [str(one) for one in owner]
    return AttackSetup.of_people(shown, names, generator(tuple(kind)), photos=3, seed=0)


def test_the_pair_is_private_and_rejects_the_fewest() -> None:
    setup = people(700, FACES)
    axes, m, why, tried = choose(setup.halves()[0], strategy=Strategy.ADVERSARIAL)
    private = [one for one in tried if one.rejected is not None]
    assert why == "fewest probes rejected of what is private"
    assert {one.axes for one in tried} == set(axes_to_try(setup.source))
    assert all(one.theft <= AIM for one in private)
    (chosen,) = [one for one in private if (one.axes, one.m) == (axes, m)]
    least = min(one.rejected.value for one in private if one.rejected is not None)
    assert chosen.rejected is not None
    assert chosen.rejected.value == least
    assert tried == tuple(sorted(tried, key=lambda one: (one.axes, one.m)))


def test_others_are_judged_than_were_chosen_by() -> None:
    setup = people(700, FACES)
    shares: list[float] = []
    point = choose_and_judge(setup, strategy=Strategy.ADVERSARIAL, progress=shares.append)
    assert point.privacy.basis["victims"] == len(setup.victims) - len(setup.halves()[0].victims)
    assert (point.privacy.basis["axes"], point.privacy.basis["m"]) == (point.axes, point.dim)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert Judgement.from_json(point.privacy.to_json()) == point.privacy


def test_what_is_asked_for_is_judged_on_everybody() -> None:
    setup = people(300, OTHER)
    point = choose_and_judge(setup, strategy=Strategy.ADVERSARIAL, axes=40, m=8)
    assert (point.axes, point.dim, point.chosen, point.tried) == (40, 8, "asked for", ())
    assert point.privacy.basis["victims"] == len(setup.victims) == 150
    assert point.privacy.rate.value > 0.5


def test_of_decoys_that_hide_nothing_the_least_theft_is_taken() -> None:
    choosing = people(300, OTHER).halves()[0]
    axes, m, why, tried = choose(choosing, strategy=Strategy.ADVERSARIAL, axes=48)
    assert why == "the least theft, as nothing is private"
    assert min(one.theft for one in tried) > AIM
    assert (axes, m) == min((one.theft, (one.axes, one.m)) for one in tried)[1]


def test_without_second_photos_the_smallest_share_of_directions_is_taken() -> None:
    setup = people(400, FACES, photos=1)
    axes, m, why, tried = choose(setup.halves()[0], strategy=Strategy.ADVERSARIAL)
    assert why == "smallest share of directions of what is private"
    private = {(one.axes, one.m) for one in tried if one.theft <= AIM}
    assert (axes, m) in private
    assert all(one.rejected is None for one in tried)


def test_dimensions_fit_the_axes_and_the_size_of_a_template() -> None:
    for axes in (4, 48, 224, 332):
        dims = dims_to_try(axes)
        assert all(1 <= m < axes and 2 * axes * (m + 1) <= MOST_BYTES for m in dims)
        assert dims == tuple(sorted(set(dims)))
    assert axes_to_try(make_pool()) == (64,)


def theft(faces: int | None, found: Rate) -> Recovery:
    """What an attacker of so many faces gets; None without limit."""
    details = {"faces": "unlimited, simulated" if faces is None else faces}
    guesses = Guesses(np.zeros((1, 1)), details=details)
    return Recovery("second-moments", guesses, found, found, 0.5, 0.0)


@pytest.mark.parametrize(
    ("people", "faces", "found", "uncovered", "status"),
    [
        (100, 1000, 0, None, "PASS"),
        (100, 1000, 5, None, "NOT SHOWN"),  # the bound is 10.2 %
        (300, 1000, 15, None, "PASS"),
        (300, 1000, 16, None, "FAIL"),
        (99, 1000, 0, None, "NOT SHOWN"),
        (100, 999, 0, None, "NOT SHOWN"),
        (300, 5000, 0, "an attacker with the pool finds the decoys", "NOT SHOWN"),
    ],
)
def test_a_verdict_passes_only_what_is_shown(
    people: int, faces: int, found: int, uncovered: str | None, status: str
) -> None:
    rate, none = Rate(found, people, 0.0, 1.0), Rate(0, people, 0.0, 1.0)
    thefts = (theft(0, none), theft(faces, rate), theft(None, Rate(0, 300, 0.0, 1.0)))
    judgement = judge_privacy(thefts, axes=224, m=96, uncovered=uncovered)
    assert judgement.status == status
    assert Judgement.from_json(judgement.to_json()) == judgement


def test_who_knows_the_moments_exactly_may_be_the_strongest() -> None:
    few, many = Rate(0, 200, 0.0, 1.0), Rate(60, 300, 0.0, 1.0)
    thefts = (theft(5000, few), theft(None, many))
    judgement = judge_privacy(thefts, axes=224, m=96)
    assert (judgement.status, judgement.basis["attacker_faces"]) == ("FAIL", "unlimited")


RATE_OF_GROUP = Rate(1, 1000, 0.0, 1.0)


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
                levels=(level_of(*groups_of(60, 4), *groups_of(*[999] * 3, judged=False)[2:]),),
                probe_photos=3,
            ),
            make_calibration(**LIFTED, levels=(level_of(),)),
        ),
    )
    judgement = judge_groups(contract)
    assert judgement is not None
    assert (judgement.status, judgement.rate.errors, judgement.limit) == ("FAIL", 60, 0.02)
    assert (judgement.basis["group"], judgement.basis["probe_photos"]) == ("g0", 3)
    assert Judgement.from_json(judgement.to_json()) == judgement


@pytest.mark.parametrize(
    ("groups", "status"),
    [
        # 31 of 1,000 where 20 pass: rarely by chance of one group, and often of 40.
        (groups_of(31), "FAIL"),
        (groups_of(31, *[0] * 39), "NOT SHOWN"),
        (groups_of(20), "PASS"),  # twice the target
        (groups_of(20, judged=False), None),  # too small
        ((), None),
    ],
)
def test_the_highest_of_many_groups_may_be_above_by_chance(
    groups: tuple[GroupRates, ...], status: str | None
) -> None:
    calibration = make_calibration(levels=(level_of(*groups),))
    judgement = judge_groups(make_contract(calibrations=(calibration,)))
    assert (None if judgement is None else judgement.status) == status
    assert judgement is None or judgement.basis["groups"] == len(groups)
    assert judgement is None or (judgement.shortfall is None) == (status != "NOT SHOWN")


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


@pytest.mark.parametrize(("count", "photos"), [(30, 1), (60, 2), (200, 1)])
def test_people_who_are_too_few_to_part_show_nothing(count: int, photos: int) -> None:
    point = choose_and_judge(people(count, FACES, photos=photos), strategy=Strategy.ADVERSARIAL)
    assert point.privacy.status == "NOT SHOWN"
    assert "too few to choose by" in str(point.privacy.shortfall)


def test_a_few_second_photos_do_not_leave_the_others_unattacked() -> None:
    setup = people(500, FACES, photos=1)
    rows_of = np.concatenate([setup.victims.enrolled, setup.faces])
    names = ["twice", "twice", *map(str, range(len(rows_of) - 2))]
    mixed = AttackSetup.of_people(rows_of, names, setup.source, photos=3, seed=0)
    assert len(mixed.victims) == 2 * LEAST_VICTIMS


def test_a_group_that_is_shown_to_be_above_is_not_hidden_by_a_small_one() -> None:
    big = GroupRates("kind", "big", Rate(30_000, 10**6, 0.0, 1.0), RATE_OF_GROUP, True, True)
    small = GroupRates("kind", "small", Rate(4, 100, 0.0, 1.0), RATE_OF_GROUP, True, True)
    level = level_of(big, small)
    judgement = judge_groups(make_contract(calibrations=(make_calibration(levels=(level,)),)))
    assert judgement is not None
    assert (judgement.status, judgement.basis["group"]) == ("FAIL", "big")


def test_a_few_probes_do_not_show_that_hardly_any_is_rejected() -> None:
    for errors, status in ((0, "NOT SHOWN"), (9, "FAIL")):
        seen = Rate(errors, 140, 0.0, 1.0)
        level = Level("fmr-1e-3", 1e-3, 2.0, seen, seen, fnmr_by_photos={3: seen})
        contract = make_contract(
            calibrations=(make_calibration(levels=(level,), probe_photos=3),),
            default_level="fmr-1e-3",
        )
        assert judge_accuracy(contract, photos=1000, not_acquired=0).status == status
