"""The search against brute force, and its vote."""

import numpy as np
import pytest

from attacks.attributes.neighbours import METRICS, nearest_neighbours, vote, votes
from templates.decoys import DecoyPool
from templates.distances import Metric, Neighbours, pairwise_distances
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from tests.attacks.attributes.people import faces

GALLERY = faces(300, seed=1).embeddings
VICTIMS = faces(40, seed=2).embeddings
TEMPLATES = lift(
    VICTIMS,
    strategy="adversarial",
    m=3,
    source=DecoyPool(faces(50, seed=3).embeddings),
    stream=Keystream.seeded("neighbours"),
)


@pytest.mark.parametrize("metric", METRICS)
def test_what_sorting_all_distances_gives(metric: Metric) -> None:
    near = nearest_neighbours(TEMPLATES, GALLERY, k=12)[metric]
    exact = pairwise_distances(GALLERY, TEMPLATES, metric=metric).T
    np.testing.assert_allclose(near.distances, np.sort(exact, axis=1)[:, :12], atol=2e-5)
    at = np.take_along_axis(exact, near.indices, axis=1)
    np.testing.assert_allclose(at, near.distances, atol=2e-5)
    assert all(len(set(row)) == 12 for row in near.indices.tolist())


def test_raw_embeddings_are_compared_as_points() -> None:
    near = nearest_neighbours(VICTIMS, GALLERY, k=5, metrics=(Metric.EUCLIDEAN,))
    exact = np.linalg.norm(VICTIMS[:, None].astype(np.float64) - GALLERY[None], axis=2)
    np.testing.assert_array_equal(near[Metric.EUCLIDEAN].indices, np.argsort(exact)[:, :5])


def test_votes_are_shares_and_the_nearest_settles_a_tie() -> None:
    labels = np.array([0, 1, 2, 1, 0])
    near = Neighbours(np.array([[4, 1, 3, 0], [2, 0, 1, 3]]), np.zeros((2, 4), np.float32))
    np.testing.assert_array_equal(
        votes(near, labels, 3, k=4), np.array([[0.5, 0.5, 0], [0.25, 0.5, 0.25]], np.float32)
    )
    assert vote(near, labels, 3, k=4).tolist() == [0, 1]
    assert vote(near, labels, 3, k=3).tolist() == [1, 2]
