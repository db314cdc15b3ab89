"""What is inside a template, and what is near it."""

import numpy as np
import pytest

from attacks.stored.nearest_neighbour import nearest_entries, nearest_points
from attacks.stored.stolen_template import flats_inside, points_inside
from templates.distances import Metric, paired_distances
from tests.attacks.beds import AXES, bed_of, noise


def test_points_and_flats_inside_are_at_distance_0() -> None:
    bed = bed_of()
    points = points_inside(bed.templates, seed=0)
    assert np.linalg.norm(points, axis=1) == pytest.approx(1, abs=1e-3)
    flats = flats_inside(bed.templates, 3, foot_norm=0.5)
    assert flats.m == 3
    assert flats.foot_norms == pytest.approx(0.5, abs=2e-3)
    for probes in (points, flats):
        assert paired_distances(probes, bed.templates, metric="spherical").max() < 0.01


def test_the_nearest_entry_is_that_of_brute_force() -> None:
    templates = bed_of("pool").templates[:4]
    gallery = noise(50, templates.n)
    bases = templates.bases.astype(np.float64)
    for metric in Metric:
        distances = np.empty((4, 50))
        for row in range(4):
            offset = gallery - templates.feet[row]
            along = offset @ bases[row].T
            if metric is Metric.EUCLIDEAN:
                squares = np.sum(offset**2, axis=1) - np.sum(along**2, axis=1)
            else:
                reach = np.linalg.norm(gallery @ bases[row].T, axis=1)
                squares = 2 - 2 * (gallery @ templates.feet[row] + templates.radii[row] * reach)
            distances[row] = squares
        expected = np.argsort(distances, axis=1)[:, :3]
        assert np.array_equal(nearest_entries(gallery, templates, count=3, metric=metric), expected)


def test_the_nearest_point_is_a_unit_vector_of_the_template_and_the_best_one() -> None:
    templates = bed_of().templates[:5]
    points = noise(5, AXES)
    found = nearest_points(points, templates)
    rng = np.random.default_rng(0)
    for row in range(5):
        assert np.linalg.norm(found[row]) == pytest.approx(1, abs=1e-3)
        assert templates[row].contains(found[row], tol=2e-3)
        drawn = nearest_points(rng.standard_normal((200, AXES)), templates[[row] * 200])
        assert (drawn @ points[row]).max() <= found[row] @ points[row] + 1e-6
