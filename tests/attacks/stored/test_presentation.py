from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from attacks.decisions import decide
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.stored.honest_probes import (
    flats_inside,
    honest_embedding,
    honest_lift,
    points_inside,
)
from attacks.stored.presentation import lift_own_templates, presentation_attack
from attacks.stored.wolf_ascent import Ground, ascend_points, ascend_subspaces
from attacks.stored.wolves import axis_wolves
from templates.distances import paired_distances
from templates.space.subspace import SubspaceBatch
from tests.attacks.stored.systems import VICTIMS, counts, noise, share, system_of


@cache
def found(decoys: str) -> dict[str, AttackOutcome]:
    return {outcome.variant: outcome for outcome in presentation_attack(system_of(decoys))}


@pytest.mark.long
def test_every_probe_is_judged_as_the_service_decides_and_reported_by_the_threshold_alone() -> None:
    outcomes = found("generator")
    judged = [name for name, outcome in outcomes.items() if outcome.judged]
    assert len(judged) == 11
    assert sorted(outcomes) == sorted(judged + [f"{name}; threshold alone" for name in judged])


@pytest.mark.parametrize("what", ["replay as embedding", "replay as lifted probe"])
def test_replay_opens_the_template_with_the_key_only(what: str) -> None:
    with_key = found("generator")[f"{what}, with the key"]
    without = found("generator")[f"{what}, without the key"]
    assert counts(with_key) == (VICTIMS, VICTIMS)
    assert with_key.knowledge is Knowledge.KEY
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
def test_a_wolf_that_knows_the_pool_opens_many_templates() -> None:
    # Templates share the decoys of a pool; the cohort, made of nobody, has none of them.
    wolf = found("pool")["wolf, optimised"]
    assert share(wolf) > 0.1
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


def ground_of(*, cohort_test: bool) -> Ground:
    system = system_of("generator")
    own = lift_own_templates(system)
    level = system.level
    if not cohort_test:
        level = replace(level, cohort_threshold=-np.inf)
    return Ground.of(own.targets, own.cohort, level)


@pytest.mark.parametrize("cohort_test", [False, True])
def test_the_slopes_are_those_of_finite_differences(cohort_test: bool) -> None:
    ground = ground_of(cohort_test=cohort_test)
    rng = np.random.default_rng(0)
    start = 0.4 + 0.1 * rng.standard_normal((1, len(ground.feet)))
    # The spread in the first factor is a unit of length, held constant: see the module.
    value, slopes = ground.slopes(start)
    assert value.shape == (1,)
    for column in (0, ground.targets - 1):
        moved = start.copy()
        moved[0, column] += 1e-5
        assert (ground.slopes(moved)[0] - value)[0] / 1e-5 == pytest.approx(
            slopes[0, column], rel=1e-3, abs=1e-9
        )


def test_climbing_raises_the_share_that_accepts() -> None:
    system = system_of("generator")
    rule = replace(system.level, cohort_threshold=-np.inf)
    own = lift_own_templates(system)
    ground = Ground.of(own.targets, own.cohort, rule)
    starts = noise(4, system.templates.n)
    ends = ascend_points(starts, ground)
    assert np.linalg.norm(ends, axis=1) == pytest.approx(1, abs=1e-5)

    def mean_near(probes: np.ndarray | SubspaceBatch, lifted: bool) -> float:
        calibration = system.lifted if lifted else system.points
        assert calibration is not None
        return float(decide(probes, own.targets, system.contract, calibration, rule).near.mean())

    assert mean_near(ends, False) > mean_near(starts, False)
    assert system.lifted is not None
    wolves = axis_wolves(system.attacker, system.lifted.probe_m, foot_norm=0.5, seed=0)
    first = SubspaceBatch.of([wolf.subspace for wolf in wolves[1:4]])
    climbed = ascend_subspaces(first, ground)
    for wolf in climbed:
        wolf.validate(1e-4)
    assert climbed.foot_norms == pytest.approx(first.foot_norms, abs=1e-4)
    assert mean_near(climbed, True) > mean_near(first, True)


def test_the_same_seed_gives_the_same_figures() -> None:
    again = presentation_attack(system_of("generator"))
    assert [outcome.to_json() for outcome in again] == [
        outcome.to_json() for outcome in found("generator").values()
    ]
