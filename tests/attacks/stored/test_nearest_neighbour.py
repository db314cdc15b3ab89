from dataclasses import replace

import numpy as np
import pytest

from attacks.stored.nearest_neighbour import (
    nearest_entries,
    nearest_neighbour_attack,
    nearest_points,
)
from attacks.stored.oracle import best_of, oracle_attack
from templates.distances import Metric
from tests.attacks.stored.systems import (
    VICTIMS,
    counts,
    noise,
    number,
    share,
    system_of,
)


def test_the_nearest_entry_is_that_of_brute_force() -> None:
    system = system_of("pool")
    templates = system.templates[:4]
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
    templates = system_of("pool").templates[:5]
    points = noise(5, templates.n)
    found = nearest_points(points, templates)
    rng = np.random.default_rng(0)
    for row in range(5):
        assert np.linalg.norm(found[row]) == pytest.approx(1, abs=1e-3)
        assert templates[row].contains(found[row], tol=2e-3)
        drawn = nearest_points(rng.standard_normal((200, templates.n)), templates[[row] * 200])
        assert (drawn @ points[row]).max() <= found[row] @ points[row] + 1e-6


def test_a_victim_in_the_gallery_is_recognised() -> None:
    found = nearest_neighbour_attack(system_of("pool"))[0]
    assert found.variant == "victim in the gallery"
    assert share(found) > 0.9
    assert found.chance == pytest.approx(1 / number(found.details["gallery"]))
    assert not found.judged


def test_without_the_victim_the_neighbour_is_somebody_else() -> None:
    system = system_of("generator")
    hidden = nearest_neighbour_attack(system)[1]
    assert hidden.judged
    assert share(hidden) < 0.5
    # Positive control: the victim's own photo among the attacker's faces.
    known = replace(system, attacker=np.concatenate([system.attacker, system.victims.fresh]))
    assert share(nearest_neighbour_attack(known)[1]) > 0.9


def test_noise_is_not_recognised() -> None:
    system = system_of("generator")
    others = system.lift(noise(VICTIMS, system.templates.n), "noise")
    identify, guess = nearest_neighbour_attack(replace(system, templates=others))
    assert counts(identify)[0] <= 2
    assert counts(guess)[0] <= 2


def test_the_oracle_names_the_nearest_of_the_neighbours() -> None:
    gallery, truth = noise(30, 12), noise(3, 12, seed=1)
    entries = np.array([[0, 5, 9], [1, 2, 3], [29, 4, 6]])
    best = best_of(gallery, entries, truth)
    for row in range(3):
        distances = [np.linalg.norm(gallery[entry] - truth[row]) for entry in entries[row]]
        assert np.array_equal(best[row], gallery[entries[row][int(np.argmin(distances))]])


def test_the_oracle_comes_nearer_with_more_neighbours_and_when_projected() -> None:
    neighbour, projected = oracle_attack(system_of("generator"), neighbours=(1, 10, 100))
    for outcome in (neighbour, projected):
        assert not outcome.judged
        curve = outcome.details["curve"]
        assert isinstance(curve, list)
        distances = [number(point["distance_to_truth_mean"]) for point in curve]  # type: ignore[call-overload, index]
        assert distances == sorted(distances, reverse=True)
    assert share(projected) > 0.9 > share(neighbour)


def test_the_oracle_of_noise_finds_no_victim() -> None:
    system = system_of("generator")
    victims = replace(system.victims, fresh=noise(VICTIMS, system.templates.n, seed=8))
    for outcome in oracle_attack(replace(system, victims=victims), neighbours=(50,)):
        assert counts(outcome)[0] <= 2
