"""What wolves climb by, and what is inside a template."""

from dataclasses import replace

import numpy as np
import pytest

from attacks.decisions import score
from attacks.point_ascent import ascend_points
from attacks.stored.nearest_neighbour import best_of, nearest_entries, nearest_points
from attacks.stored.stolen_template import flats_inside, points_inside
from attacks.stored.wolves import ALONG_MEAN, COHORT_CLIMBED, OwnTemplates, axis_wolves
from attacks.wolf_ascent import Ground, ascend_subspaces
from templates.distances import Metric, paired_distances
from templates.space.subspace import SubspaceBatch
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


def test_the_slopes_of_a_cohort_are_those_of_finite_differences() -> None:
    bed = bed_of()
    own = OwnTemplates.of(bed)
    ground = Ground.of(own.targets, own.cohort[:COHORT_CLIMBED], bed.level)
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
    bed = bed_of()
    rule = replace(bed.level, threshold=1.5)  # where there is something to gain
    own = OwnTemplates.of(bed)
    starts = noise(4)
    ends = ascend_points(starts, own.targets, bed.nobody, threshold=rule.threshold)
    assert np.linalg.norm(ends, axis=1) == pytest.approx(1, abs=1e-5)
    cohort = own.cohort[:COHORT_CLIMBED]  # climbed on, as the targets are

    def accepted(probes: np.ndarray | SubspaceBatch, lifted: bool) -> float:
        calibration = bed.lifted if lifted else bed.points
        assert calibration is not None
        found = score(probes, own.targets, bed.nobody, calibration, cohort=cohort)
        return float(found.at(rule).mean())

    assert accepted(ends, False) > accepted(starts, False)
    assert bed.lifted is not None
    wolves = axis_wolves(bed.gallery, bed.lifted.probe_m, foot_norm=0.5, seed=0)
    first = wolves[ALONG_MEAN][:3]
    climbed = ascend_subspaces(first, Ground.of(own.targets, cohort, rule))
    for wolf in climbed:
        wolf.validate(1e-4)
    assert climbed.foot_norms == pytest.approx(first.foot_norms, abs=1e-4)
    assert accepted(climbed, True) > accepted(first, True)


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


def test_the_oracle_names_the_nearest_of_the_neighbours() -> None:
    gallery, truth = noise(30, 12), noise(3, 12, seed=1)
    entries = np.array([[0, 5, 9], [1, 2, 3], [29, 4, 6]])
    best = best_of(gallery, entries, truth)
    for row in range(3):
        distances = [np.linalg.norm(gallery[entry] - truth[row]) for entry in entries[row]]
        assert np.array_equal(best[row], gallery[entries[row][int(np.argmin(distances))]])
