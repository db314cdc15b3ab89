from dataclasses import replace

import numpy as np
import pytest

from attacks.decisions import decide
from attacks.hill_climbing import dictionary_outcomes
from attacks.outcomes import AttackOutcome, Knowledge, Property
from attacks.prior import attacker_prior
from attacks.system import System
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import N


def by_limit(outcomes: list[AttackOutcome]) -> dict[int, AttackOutcome]:
    return {outcome.details["limit"]: outcome for outcome in outcomes}  # type: ignore[misc]


def first_accepted(system: System, most: int) -> list[float]:
    """Number of the first face that opens each template, asked one at a time."""
    faces = attacker_prior(system).faces[:most]
    reached = []
    for number in range(len(system.templates)):
        reached.append(np.inf)
        for attempt, face in enumerate(faces, start=1):
            accepted = decide(
                face[None].astype(np.float32),
                system.templates[number : number + 1],
                system.contract,
                system.points,
                system.level,
            )
            if accepted[0, 0]:
                reached[-1] = attempt
                break
    return reached


def test_the_count_is_that_of_asking_face_after_face(system: System) -> None:
    found = by_limit(dictionary_outcomes(system))
    reached = np.array(first_accepted(system, 50))
    assert sorted(found) == [5, 50]
    for limit, outcome in found.items():
        assert outcome.measured.value == np.mean(reached <= limit)
        assert outcome.measured.trials == len(system.templates)
        assert outcome.details["attempts"] == np.minimum(reached, 50).sum()


def test_what_is_said_of_it(system: System) -> None:
    few, many = dictionary_outcomes(system)
    assert (few.attack, few.variant) == ("hill-climbing", "dictionary, decisions only, 5 attempts")
    assert {few.breaks, many.breaks} == {Property.IMPERSONATION}
    assert {few.knowledge, many.knowledge} == {Knowledge.ALGORITHM}
    assert few.judged
    assert many.judged
    assert few.level == system.level.name
    fmr = system.level.target_fmr
    assert fmr is not None
    assert many.chance == pytest.approx(1 - (1 - fmr) ** 50)
    assert few.chance < many.chance
    assert few.measured.value <= many.measured.value


def test_templates_of_the_attacker_s_own_faces_are_opened(system: System) -> None:
    """The positive control: the faces that are tried are the victims."""
    faces = attacker_prior(system).faces[:20].astype(np.float32)
    opened = replace(system, templates=system.lift(faces, "templates of known faces"))
    assert by_limit(dictionary_outcomes(opened))[50].measured.value >= 0.95


def test_templates_of_noise_are_opened_as_often_as_by_any_face(system: System) -> None:
    """The negative control: no face, and no decoy, is in these subspaces.

    Some 75 of 15,000 are opened by the first five faces, so chance does not double them; the
    attacker's order must not either.
    """
    rng = np.random.default_rng(5)
    axes = np.linalg.qr(rng.normal(size=(15_000, N, 1 + system.scheme.dim)))[0]
    axes = axes.transpose(0, 2, 1).astype(np.float32)
    length = np.float32(system.templates.foot_norms.mean())
    noise = SubspaceBatch(length * axes[:, 0], np.ascontiguousarray(axes[:, 1:]))
    closed = replace(system, templates=noise)
    faces = attacker_prior(system).faces.astype(np.float32)
    one = decide(faces, noise, system.contract, system.points, system.level).mean()
    assert one > 0
    for limit, outcome in by_limit(dictionary_outcomes(closed)).items():
        assert outcome.measured.value <= 2 * (1 - (1 - one) ** limit)


def test_a_system_gives_the_same_counts_twice(system: System) -> None:
    assert dictionary_outcomes(system) == dictionary_outcomes(system)
