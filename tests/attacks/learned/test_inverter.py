import sys
from dataclasses import replace

import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.learned.inverter import Inverter, invert, train
from attacks.system import System
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import random_rotation

pytest.importorskip("torch")


def trained(system: System, *, epochs: int = 3) -> Inverter:
    return train(
        system.attacker,
        lambda rows, epoch: system.lift(rows, f"test {epoch}"),
        seconds=1e9,
        epochs=epochs,
        seed=0,
    )


def test_another_basis_of_the_same_template_changes_nothing(system: System) -> None:
    inverter = trained(system)
    turn = random_rotation(system.templates.m)
    other = SubspaceBatch(
        system.templates.feet,
        np.ascontiguousarray(np.einsum("ab,tbn->tan", turn, system.templates.bases), np.float32),
    )
    np.testing.assert_allclose(inverter(system.templates), inverter(other), atol=1e-4)


def test_an_untrained_network_gives_the_foot_point(system: System) -> None:
    guesses = trained(system, epochs=0)(system.templates)
    feet = system.templates.feet / system.templates.foot_norms[:, None]
    np.testing.assert_allclose(guesses, feet, atol=1e-5)


def test_one_seed_gives_one_network(system: System) -> None:
    first, second = trained(system, epochs=2), trained(system, epochs=2)
    np.testing.assert_array_equal(first(system.templates), second(system.templates))


@pytest.mark.long
def test_training_beats_the_foot_point_where_decoys_differ_from_faces(system: System) -> None:
    """Faces on one half of the axes, decoys on the other: a network must tell them apart."""
    rng = np.random.default_rng(0)
    half = system.templates.n // 2

    def rows(count: int) -> np.ndarray:
        drawn = np.zeros((count, 2 * half), dtype=np.float32)
        drawn[:, :half] = rng.normal(size=(count, half))
        return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)

    def lift(people: np.ndarray, epoch: int) -> SubspaceBatch:
        from templates.keys.randomness import Keystream

        with Keystream.seeded("apart", epoch) as stream:
            decoys = np.zeros((len(people), 4, 2 * half))
            decoys[:, :, half:] = stream.normal((len(people), 4, half))
            decoys /= np.linalg.norm(decoys, axis=2, keepdims=True)
            return SubspaceBatch.through(people, decoys - people[:, None], stream=stream)

    inverter = train(rows(600), lift, seconds=1e9, epochs=12, seed=0)
    people = rows(100)
    batch = lift(people, 10_000)
    cosines = np.einsum("ij,ij->i", inverter(batch), people)
    assert cosines.mean() > batch.foot_norms.mean() + 0.2
    assert inverter.held_out_cosine > inverter.held_out_foot + 0.2


def test_outcomes_on_weak_templates_and_on_noise(
    system: System, weak_system: System, strangers: np.ndarray
) -> None:
    _, (weak,) = invert(weak_system, seconds=1e9, epochs=2, seed=0)
    assert weak.measured.value > 0.8
    noise = replace(system, templates=system.lift(strangers, "noise"))
    _, (row,) = invert(noise, seconds=1e9, epochs=2, seed=0)
    assert row.measured.value <= 0.1
    assert row.details["faces"] == len(system.attacker)


def test_too_few_faces_are_refused(system: System) -> None:
    with pytest.raises(AuditError, match="40 faces"):
        train(system.attacker[:10], lambda rows, epoch: system.lift(rows, "x"), seed=0)


def test_without_torch_the_remedy_is_named(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(AuditError, match=r'pip install "veilface\[torch\]"'):
        invert(system, seed=0)
