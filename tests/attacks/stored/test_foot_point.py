from dataclasses import replace

import numpy as np
import pytest

from attacks.outcomes import Knowledge
from attacks.stored.foot_point import foot_point_attack, foot_points
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from tests.attacks.stored.systems import VICTIMS, counts, noise, number, system_of


def test_the_cosine_is_the_norm_of_the_foot_point() -> None:
    (outcome,) = foot_point_attack(system_of("generator"))
    assert number(outcome.details["largest_gap_of_cosine_to_foot_norm"]) < 1e-3
    # Six decoys beside the descriptor, nearly orthogonal: ‖p‖² ≈ 1/7.
    assert number(outcome.details["foot_norm_mean"]) == pytest.approx(7**-0.5, abs=0.05)
    assert outcome.knowledge is Knowledge.TEMPLATE
    assert outcome.judged


def test_random_lifting_hides_nothing() -> None:
    system = system_of("generator")
    with Keystream.seeded("random") as stream:
        plain = lift(system.victims.enrolled, strategy="random", m=2, stream=stream)
    (outcome,) = foot_point_attack(replace(system, templates=plain))
    assert counts(outcome) == (VICTIMS, VICTIMS)


def test_templates_of_noise_tell_nothing_of_the_victims() -> None:
    system = system_of("generator")
    others = system.lift(noise(VICTIMS, system.templates.n), "noise")
    (outcome,) = foot_point_attack(replace(system, templates=others))
    assert counts(outcome)[0] <= 1
    assert outcome.chance == system.level.target_fmr


def test_directions_are_unit_vectors() -> None:
    system = system_of("generator")
    found = foot_points(system.templates)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1)
    assert np.abs(np.einsum("ij,imj->im", found, system.templates.bases)).max() < 1e-3
