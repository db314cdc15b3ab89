from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from attacks.decisions import decide
from attacks.outcomes import AttackOutcome, Knowledge, Leaked
from attacks.stored.honest_probes import (
    flats_inside,
    honest_embedding,
    honest_lift,
    points_inside,
)
from attacks.stored.point_ascent import ascend_points
from attacks.stored.presentation import (
    COHORT_CLIMBED,
    lift_own_templates,
    presentation_attack,
)
from attacks.stored.wolf_ascent import ascend_subspaces
from attacks.stored.wolves import axis_wolves
from templates.distances import paired_distances
from templates.space.subspace import SubspaceBatch
from tests.attacks.stored.systems import VICTIMS, counts, noise, share, system_of


@cache
def found(decoys: str) -> dict[str, AttackOutcome]:
    return {outcome.variant: outcome for outcome in presentation_attack(system_of(decoys))}


@pytest.mark.long
def test_every_probe_is_judged() -> None:
    outcomes = found("generator")
    assert len(outcomes) == 11
    assert all(outcome.judged for outcome in outcomes.values())


@pytest.mark.parametrize("what", ["replay as embedding", "replay as lifted probe"])
def test_replay_opens_the_template_with_the_key_only(what: str) -> None:
    with_key = found("generator")[f"{what}, with the key"]
    without = found("generator")[f"{what}, without the key"]
    assert counts(with_key) == (VICTIMS, VICTIMS)
    assert with_key.leaked is Leaked.HOLDER_KEYS
    assert counts(without)[0] <= 1


def test_zero_and_central_probes_are_refused_before_the_decision() -> None:
    outcomes = found("generator")
    assert outcomes["zero embedding"].details["refused_by_the_input_checks"] == 1
    central = outcomes["random central subspaces"]
    assert central.details["refused_by_the_input_checks"] == VICTIMS
    assert counts(outcomes["zero embedding"])[0] == counts(central)[0] == 0
    wolf = outcomes["wolf, axes through the origin"]
    assert wolf.details["refused_by_the_input_checks"] == 1


@pytest.mark.long
def test_a_wolf_that_knows_the_pool_has_more_to_go_by_and_opens_few() -> None:
    # Templates share the decoys of a pool; templates of nobody have none of them. By the two
    # thresholds of before such wolves opened more than a tenth.
    wolf = found("pool")["wolf, optimised"]
    assert share(wolf) < 0.1
    assert wolf.knowledge is Knowledge.DECOYS
    assert found("generator")["wolf, optimised"].knowledge is Knowledge.ALGORITHM
    assert share(found("generator")["wolf, optimised"]) < 0.1


def test_points_and_flats_inside_are_at_distance_0() -> None:
    system = system_of("generator")
    points = points_inside(system.templates, seed=0)
    assert np.linalg.norm(points, axis=1) == pytest.approx(1, abs=1e-3)
    flats = flats_inside(system.templates, 3, foot_norm=0.5)
    assert flats.m == 3
    assert flats.foot_norms == pytest.approx(0.5, abs=2e-3)
    for probes in (points, flats):
        assert paired_distances(probes, system.templates, metric="spherical").max() < 0.01


def test_the_input_checks_are_those_of_the_service() -> None:
    rows = noise(3, 64) * np.array([[1.0], [1.01], [0.0]], dtype=np.float32)
    assert honest_embedding(rows).tolist() == [True, False, False]
    system = system_of("generator")
    calibration = system.lifted
    assert calibration is not None
    assert calibration.foot_point_norm is not None
    honest = system.lift(noise(20, 64), "honest", m=calibration.probe_m)
    assert honest_lift(honest, calibration).all()
    zero = SubspaceBatch(0 * honest.feet, honest.bases)
    assert not honest_lift(zero, calibration).any()


def test_the_slopes_of_a_cohort_are_those_of_finite_differences() -> None:
    system = system_of("generator")
    own = lift_own_templates(system)
    ground = own.ground(system.level)
    rng = np.random.default_rng(0)
    start = 0.4 + 0.1 * rng.standard_normal((1, len(ground.feet)))
    value, slopes = ground.slopes(start)
    assert value.shape == (1,)
    for column in (0, ground.targets - 1, ground.targets, len(ground.feet) - 1):
        moved = start.copy()
        moved[0, column] += 1e-5
        assert (ground.slopes(moved)[0] - value)[0] / 1e-5 == pytest.approx(
            slopes[0, column], rel=1e-3, abs=1e-9
        )


def test_climbing_raises_the_share_that_accepts() -> None:
    system = system_of("generator")
    rule = replace(system.level, threshold=1.5)  # where there is something to gain
    own = lift_own_templates(system)
    starts = noise(4, system.templates.n)
    ends = ascend_points(starts, own.targets, system.nobody, threshold=rule.threshold)
    assert np.linalg.norm(ends, axis=1) == pytest.approx(1, abs=1e-5)

    def accepted(probes: np.ndarray | SubspaceBatch, lifted: bool) -> float:
        calibration = system.lifted if lifted else system.points
        assert calibration is not None
        # Climbed on: templates and cohort of the attacker's own.
        cohort = own.cohort[:COHORT_CLIMBED]
        return float(
            decide(probes, own.targets, system.nobody, calibration, rule, cohort=cohort).mean()
        )

    assert accepted(ends, False) > accepted(starts, False)
    assert system.lifted is not None
    wolves = axis_wolves(system.attacker, system.lifted.probe_m, foot_norm=0.5, seed=0)
    first = SubspaceBatch.of([wolf.subspace for wolf in wolves[1:4]])
    climbed = ascend_subspaces(first, own.ground(rule))
    for wolf in climbed:
        wolf.validate(1e-4)
    assert climbed.foot_norms == pytest.approx(first.foot_norms, abs=1e-4)
    assert accepted(climbed, True) > accepted(first, True)


@pytest.mark.long
def test_the_same_seed_gives_the_same_figures() -> None:
    again = presentation_attack(system_of("generator"))
    assert [outcome.to_json() for outcome in again] == [
        outcome.to_json() for outcome in found("generator").values()
    ]
