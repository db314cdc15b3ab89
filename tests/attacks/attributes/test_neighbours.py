"""The search against brute force, and its vote."""

import tracemalloc

import numpy as np
import pytest

from attacks.attributes.neighbours import (
    METRICS,
    merged,
    nearest_neighbours,
    vote,
    votes,
)
from attacks.errors import AuditError
from templates.decoys import DecoyPool
from templates.distances import Metric, Neighbours, compiled, pairwise_distances
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from tests.attacks.attributes.people import faces

GALLERY = faces(300, seed=1).descriptors
VICTIMS = faces(40, seed=2).descriptors
TEMPLATES = lift(
    VICTIMS,
    strategy="adversarial",
    m=3,
    source=DecoyPool(faces(50, seed=3).descriptors),
    stream=Keystream.seeded("neighbours"),
)


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("size", [1 << 19, 1 << 11])
def test_finds_what_sorting_all_distances_finds(
    metric: Metric, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "_TASK_PAIRS", size)
    found = nearest_neighbours(TEMPLATES, GALLERY, k=12)[metric]
    exact = pairwise_distances(GALLERY, TEMPLATES, metric=metric, dtype=np.float64).T
    np.testing.assert_allclose(found.distances, np.sort(exact, axis=1)[:, :12], atol=2e-5)
    at = np.take_along_axis(exact, found.indices, axis=1)
    np.testing.assert_allclose(at, found.distances, atol=2e-5)
    assert all(len(set(row)) == 12 for row in found.indices.tolist())


def test_raw_descriptors_are_compared_as_points() -> None:
    found = nearest_neighbours(VICTIMS, GALLERY, k=5, metrics=(Metric.EUCLIDEAN,))
    gaps = VICTIMS[:, None].astype(np.float64) - GALLERY[None]
    exact = np.linalg.norm(gaps, axis=2)
    np.testing.assert_array_equal(found[Metric.EUCLIDEAN].indices, np.argsort(exact)[:, :5])


def test_a_face_in_the_gallery_is_found_at_distance_0_or_skipped() -> None:
    gallery = np.vstack([GALLERY, VICTIMS])
    own = 300 + np.arange(40)
    for metric, found in nearest_neighbours(TEMPLATES, gallery, k=4).items():
        np.testing.assert_array_equal(found.indices[:, 0], own)
        assert found.distances[:, 0].max() < 1e-5, metric
    plain = nearest_neighbours(TEMPLATES, gallery, k=5)
    for metric, found in nearest_neighbours(TEMPLATES, gallery, k=4, skip=own).items():
        np.testing.assert_array_equal(found.indices, plain[metric].indices[:, 1:])


def test_two_searches_find_what_one_does() -> None:
    one, parts = (
        nearest_neighbours(TEMPLATES, GALLERY, k=9),
        [nearest_neighbours(TEMPLATES, part, k=9) for part in (GALLERY[:100], GALLERY[100:])],
    )
    for metric, whole in one.items():
        both = merged(parts[0][metric], parts[1][metric], after=100, k=9)
        np.testing.assert_array_equal(both.indices, whole.indices)
        np.testing.assert_allclose(both.distances, whole.distances, atol=1e-6)


def test_memory_does_not_grow_with_the_gallery(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiled, "_TASK_PAIRS", 1 << 15)

    def peak(rows: int) -> int:
        gallery = np.resize(GALLERY, (rows, 64))
        tracemalloc.start()
        nearest_neighbours(TEMPLATES, gallery, k=5)
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(65_536)  # leaves its working space to the next
    small, large = peak(8_192), peak(65_536)
    # All distances of the larger gallery take 21 MB for the two metrics.
    assert large < small + 2_000_000


def test_more_neighbours_than_faces_are_refused() -> None:
    with pytest.raises(AuditError, match="among 300 faces"):
        nearest_neighbours(TEMPLATES, GALLERY, k=301)
    with pytest.raises(AuditError, match="among 300 faces"):
        nearest_neighbours(TEMPLATES, GALLERY, k=300, skip=np.arange(40))


def test_votes_are_shares_and_the_nearest_settles_a_tie() -> None:
    labels = np.array([0, 1, 2, 1, 0])
    found = Neighbours(np.array([[4, 1, 3, 0], [2, 0, 1, 3]]), np.zeros((2, 4), np.float32))
    np.testing.assert_array_equal(
        votes(found, labels, 3, k=4), np.array([[0.5, 0.5, 0], [0.25, 0.5, 0.25]], np.float32)
    )
    assert vote(found, labels, 3, k=4).tolist() == [0, 1]
    assert vote(found, labels, 3, k=3).tolist() == [1, 2]
