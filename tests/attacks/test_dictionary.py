from dataclasses import replace

import numpy as np
import pytest

from attacks.decisions import decide
from attacks.dictionary import dictionary_outcomes
from attacks.outcomes import Knowledge, Outcome, Property
from attacks.rehearsal import rehearse_scene
from attacks.scene import Scene
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import N


def by_limit(outcomes: list[Outcome]) -> dict[int, Outcome]:
    return {outcome.details["limit"]: outcome for outcome in outcomes}  # type: ignore[misc]


def first_accepted(scene: Scene, most: int) -> list[float]:
    """Number of the first face that opens each template, asked one at a time."""
    faces = rehearse_scene(scene).faces[:most]
    reached = []
    for number in range(len(scene.templates)):
        reached.append(np.inf)
        for attempt, face in enumerate(faces, start=1):
            answer = decide(
                face[None].astype(np.float32),
                scene.templates[number : number + 1],
                scene.contract,
                scene.points,
                scene.level,
            )
            if answer.accepted[0, 0]:
                reached[-1] = attempt
                break
    return reached


def test_the_count_is_that_of_asking_face_after_face(scene: Scene) -> None:
    found = by_limit(dictionary_outcomes(scene, most_attempts=50))
    reached = np.array(first_accepted(scene, 50))
    assert sorted(found) == [5, 50]
    for limit, outcome in found.items():
        assert outcome.measured.value == np.mean(reached <= limit)
        assert outcome.measured.trials == len(scene.templates)
        assert outcome.details["attempts"] == np.minimum(reached, 50).sum()


def test_what_is_said_of_it(scene: Scene) -> None:
    few, many = dictionary_outcomes(scene)
    assert (few.attack, few.variant) == ("hill-climbing", "dictionary, decisions only, 5 attempts")
    assert {few.breaks, many.breaks} == {Property.IMPERSONATION}
    assert {few.knowledge, many.knowledge} == {Knowledge.ALGORITHM}
    assert few.judged
    assert many.judged
    assert few.level == scene.level.name
    fmr = scene.level.target_fmr
    assert fmr is not None
    assert many.chance == pytest.approx(1 - (1 - fmr) ** 50)
    assert few.chance < many.chance
    assert few.measured.value <= many.measured.value


def test_templates_of_the_attacker_s_own_faces_are_opened(scene: Scene) -> None:
    """The positive control: the faces that are tried are the victims."""
    faces = rehearse_scene(scene).faces[:20].astype(np.float32)
    opened = replace(scene, templates=scene.lift(faces, "templates of known faces"))
    assert by_limit(dictionary_outcomes(opened, most_attempts=50))[50].measured.value >= 0.95


def test_templates_of_noise_are_opened_as_often_as_by_any_face(scene: Scene) -> None:
    """The negative control: no face, and no decoy, is in these subspaces.

    Some 75 of 15,000 are opened by the first five faces, so chance does not double them; the
    attacker's order must not either.
    """
    rng = np.random.default_rng(5)
    axes = np.linalg.qr(rng.normal(size=(15_000, N, 1 + scene.scheme.dim)))[0]
    axes = axes.transpose(0, 2, 1).astype(np.float32)
    length = np.float32(scene.templates.foot_norms.mean())
    noise = SubspaceBatch(length * axes[:, 0], np.ascontiguousarray(axes[:, 1:]))
    closed = replace(scene, templates=noise)
    faces = rehearse_scene(scene).faces.astype(np.float32)
    one = decide(faces, noise, scene.contract, scene.points, scene.level).accepted.mean()
    assert one > 0
    for limit, outcome in by_limit(dictionary_outcomes(closed)).items():
        assert outcome.measured.value <= 2 * (1 - (1 - one) ** limit)


def test_a_scene_gives_the_same_counts_twice(scene: Scene) -> None:
    assert dictionary_outcomes(scene) == dictionary_outcomes(scene)
