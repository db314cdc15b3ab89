"""Rates within groups, and thresholds that hold in each: against counts by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from attacks.operating_point import judge_groups
from templates.contract.document import Contract, Level
from templates.contract.levels import MAX_GROUPS
from templates.errors import ContractError
from tests.verify.synthetic import N, draw_people, make_binding, make_generator, unit
from verify import Calibrated, CalibrationOptions, calibrate
from verify.group_rates import (
    PhotoLabels,
    group_rates,
    people_groups,
    worst_group_threshold,
)
from verify.metrics import rate, threshold_at_fmr, wilson
from verify.thresholds import EXPECTED_ERRORS, Genuine, Impostors


def all_against_all(scores: NDArray[np.float32]) -> Impostors:
    """Impostor trials of one probe of each of P people against all templates, (P, P)."""
    people = len(scores)
    cells = scores.copy()
    np.fill_diagonal(cells, -np.inf)
    everybody = np.arange(people)
    return Impostors(cells, everybody, everybody[None], people, people)


def by_hand(scores: NDArray[np.float32], members: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Scores of the impostor trials within a group."""
    within = scores.astype(np.float64)[np.ix_(members, members)]
    return within[~np.eye(len(within), dtype=bool)]


@pytest.fixture
def worse() -> tuple[NDArray[np.float32], PhotoLabels]:
    """60 "b" score 1 higher among themselves; 5 "c" are too few to judge, 25 "d" to set by."""
    rng = np.random.default_rng(3)
    names = ["a"] * 200 + ["b"] * 60 + ["c"] * 5 + ["d"] * 25 + [None] * 10
    scores = rng.normal(size=(300, 300))
    scores[200:260, 200:260] += 1
    return scores.astype(np.float32), PhotoLabels({"kind": names}, "drawn")


def test_rates_are_those_of_the_trials_within(worse) -> None:
    scores, labels = worse
    everybody = np.arange(300)
    groups = people_groups(labels, everybody, people=300)
    genuine = Genuine(
        np.linspace(0, 4, 300, dtype=np.float32),
        everybody,
        np.ones(300, dtype=np.int64),
        refused=everybody % 7 == 6,
    )
    impostors = all_against_all(scores)
    some = rate(0, 10)
    level = Level("fmr-1e-2", 1e-2, 2.3, some, some)
    found = group_rates(level, groups, impostors, genuine)
    assert [(entry.attribute, entry.group) for entry in found] == [
        *(("kind", name) for name in "abcd"),
    ]
    for entry in found:
        members = np.array([name == entry.group for name in labels.of["kind"]])
        within = by_hand(scores, members)
        errors = int((within >= 2.3).sum())
        assert (entry.fmr.errors, entry.fmr.trials) == (errors, len(within))
        assert (entry.fmr.ci_low, entry.fmr.ci_high) == wilson(errors, len(within))
        rejected = int(((genuine.scores < 2.3) | genuine.refused)[members].sum())
        assert (entry.frr.errors, entry.frr.trials) == (rejected, members.sum())
    # 20 trials of "c" are fewer than 1 / 0.01, and only "a" has 100 genuine ones.
    assert [entry.fmr_judged for entry in found] == [True, True, False, True]
    assert [entry.frr_judged for entry in found] == [True, False, False, False]
    accuracy = group_rates(replace(level, target_fmr=None), groups, impostors, genuine)
    assert not any(entry.fmr_judged for entry in accuracy)


@pytest.mark.parametrize("target", [1e-2, 3e-3])
def test_the_threshold_of_the_worst_group_is_the_smallest_that_holds(worse, target) -> None:
    scores, labels = worse
    everybody = np.arange(300)
    groups = people_groups(labels, everybody, people=300)
    impostors = all_against_all(scores)
    trials = by_hand(scores, np.ones(300, dtype=bool))
    overall = threshold_at_fmr(trials, target)
    found, left_out = worst_group_threshold(overall, target, groups, impostors)
    b = by_hand(scores, np.array([name == "b" for name in labels.of["kind"]]))
    assert np.mean(b >= overall) > 2 * target
    for own in (trials, b, by_hand(scores, np.array([n == "a" for n in labels.of["kind"]]))):
        assert np.mean(own >= found) <= target
    # One more accepted score of the worst group would exceed the target.
    below = b[b < found].max()
    assert np.mean(b >= below) > target
    assert left_out == ["kind c (20)", "kind d (600)"]


def test_people_are_what_most_of_their_photos_are() -> None:
    labels = PhotoLabels(
        {
            "age": ["3-9", "10-19", "10-19", "3-9", "20-29", None],
            "race": [None] * 6,
        },
        "drawn",
    )
    (ages,) = people_groups(labels, np.array([0, 0, 0, 1, 1, 2]), people=3)
    # Years are in their order; a tie goes to the first.
    assert ages.names == ("3-9", "10-19", "20-29")
    assert ages.of.tolist() == [1, 0, -1]


def test_groups_that_a_contract_cannot_hold_are_refused_before_anything_is_computed() -> None:
    with pytest.raises(ContractError, match=f"contract holds {MAX_GROUPS}"):
        PhotoLabels({"town": [f"t{i}" for i in range(MAX_GROUPS + 1)]}, "drawn")
    with pytest.raises(ContractError, match="printable"):
        PhotoLabels({"town": ["\x1b[2J"]}, "drawn")


def calibrated_groups(
    *, worst_group: bool, count: int = 40, towards: float = 0.6
) -> tuple[Calibrated, PhotoLabels]:
    """Calibrate on 150 people, of whom some are alike."""
    people = draw_people(150)
    numbers = np.array([int(name.rsplit("-", 1)[1]) for name in people.names])
    alike = numbers < count
    centre = unit(np.random.default_rng(9).normal(size=(1, N)))
    rows = people.descriptors.copy()
    rows[alike] = unit(rows[alike] + towards * centre)
    labels = PhotoLabels({"kind": ["alike" if one else "other" for one in alike]}, "drawn")
    source = make_generator()
    done = calibrate(
        rows,
        people.names,
        binding=make_binding(source.source_id),
        source=source,
        labels=labels,
        options=CalibrationOptions(
            probe_dims=(0, 2),
            probe_photos=(1, 2),
            least_people=40,
            lifted_probes=100,
            lifted_impostor_pairs=10_000,
            steps=10,
            targets=(1e-1, 1e-2),
            worst_group=worst_group,
        ),
    )
    return done, labels


@pytest.fixture(scope="module")
def both() -> tuple[Contract, Contract, Calibrated]:
    strict, _ = calibrated_groups(worst_group=True)
    return calibrated_groups(worst_group=False)[0].contract, strict.contract, strict


def test_a_calibration_records_the_groups_of_raw_probes(both) -> None:
    plain, strict, _ = both
    for contract, rule in ((plain, False), (strict, True)):
        for calibration in contract.calibrations:
            facts = calibration.calibrated_on
            assert (facts["groups_from"], facts["worst_group"]) == ("drawn", rule)
            for level in calibration.levels:
                assert len(level.groups) == (2 if calibration.mode == "p2s" else 0)
    (alike, _) = plain.calibration("p2s").level("fmr-1e-2").groups
    # 14 people of four photos, 13 of one, 13 of three: 108 photos against 39 others.
    assert (alike.group, alike.fmr.trials) == ("alike", 108 * 39)


def test_the_worst_group_fails_without_the_rule_and_passes_with_it(both) -> None:
    plain, strict, _ = both
    failed, passed = judge_groups(plain), judge_groups(strict)
    assert (failed.status, failed.basis["group"]) == ("FAIL", "alike")
    assert failed.limit == 2 * plain.calibration("p2s").level(plain.default_level).target_fmr
    assert passed.status == "PASS"
    for before, after in zip(plain.calibrations, strict.calibrations, strict=True):
        for lax, held in zip(before.levels, after.levels, strict=True):
            # The rule is of raw probes; lifted ones are drawn anew.
            assert held.threshold >= lax.threshold or after.mode == "s2s"
            assert held.fmr.value <= held.target_fmr
            for group in held.groups:
                heeded = group.fmr.trials >= EXPECTED_ERRORS / held.target_fmr
                assert heeded == (group.group == "alike" or after.probe_photos == 1)
                assert not heeded or group.fmr.value <= held.target_fmr
        thresholds = [level.threshold for level in after.levels]
        assert thresholds == sorted(thresholds)
    single = [contract.calibration("p2s").level("fmr-1e-2") for contract in both[:2]]
    assert single[1].threshold > single[0].threshold
    assert single[1].fnmr.errors >= single[0].fnmr.errors


def test_a_stricter_level_is_never_laxer() -> None:
    """A group that only the laxer target resolves raises the stricter level as well."""
    done, _ = calibrated_groups(worst_group=True, count=12, towards=1.5)
    lax, strict = done.contract.calibration("p2s").levels
    assert strict.threshold == lax.threshold
    assert any(
        "FMR 0.01 needs 1000 impostor trials within a group" in line and "kind alike (352)" in line
        for line in done.report.left_out
    )
