import sys

import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.stored.foot_point import foot_points
from attacks.stored.inverter import Inverter, train
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.attacks.beds import bed_of
from tests.verify.synthetic import random_rotation

pytest.importorskip("torch")


def trained(*, epochs: int, faces: int = 300) -> Inverter:
    bed = bed_of()
    return train(
        bed.gallery[:faces],
        lambda rows, epoch: bed.lift(rows, f"test {epoch}"),
        foot_points,
        seconds=1e9,
        epochs=epochs,
        seed=0,
    )


def test_another_basis_of_the_same_template_changes_nothing() -> None:
    templates = bed_of().templates
    inverter = trained(epochs=2)
    turn = random_rotation(templates.m)
    other = SubspaceBatch(
        templates.feet,
        np.ascontiguousarray(np.einsum("ab,tbn->tan", turn, templates.bases), np.float32),
    )
    np.testing.assert_allclose(inverter(templates), inverter(other), atol=1e-4)
    np.testing.assert_array_equal(inverter(templates), trained(epochs=2)(templates))


def test_an_untrained_network_gives_the_nearest_point_to_its_start() -> None:
    templates = bed_of().templates
    feet = templates.feet / templates.foot_norms[:, None]
    np.testing.assert_allclose(trained(epochs=0)(templates), feet, atol=1e-5)


@pytest.mark.long
def test_training_beats_its_start_where_decoys_differ_from_faces() -> None:
    """Faces on one half of the axes, decoys on the other: a network must tell them apart."""
    rng = np.random.default_rng(0)
    half = 30

    def rows(count: int) -> np.ndarray:
        drawn = np.zeros((count, 2 * half), dtype=np.float32)
        drawn[:, :half] = rng.normal(size=(count, half))
        return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)

    def lift(people: np.ndarray, epoch: int) -> SubspaceBatch:
        stream = Keystream.seeded("apart", epoch)
        decoys = np.zeros((len(people), 4, 2 * half))
        decoys[:, :, half:] = stream.normal((len(people), 4, half))
        decoys /= np.linalg.norm(decoys, axis=2, keepdims=True)
        return SubspaceBatch.through(people, decoys - people[:, None], stream=stream)

    inverter = train(rows(600), lift, foot_points, seconds=1e9, epochs=12, seed=0)
    people = rows(100)
    batch = lift(people, 10_000)
    cosines = np.einsum("ij,ij->i", inverter(batch), people)
    assert cosines.mean() > batch.foot_norms.mean() + 0.2
    assert inverter.held_out_cosine > inverter.held_out_start + 0.2


def test_what_it_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AuditError, match="40 faces"):
        trained(epochs=1, faces=10)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(AuditError, match=r'pip install "veilface\[torch\]"'):
        trained(epochs=1)
