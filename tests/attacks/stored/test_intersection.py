from dataclasses import replace

import numpy as np
import pytest

from attacks.stored.intersection import (
    different_photos,
    meeting_point,
    nearest_common_point,
    same_descriptor,
)
from templates.decoys import DecoyPool
from tests.attacks.stored.systems import VICTIMS, counts, noise, number, share, system_of


def subspaces(count: int, m: int, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    bases = np.stack([np.linalg.qr(rng.standard_normal((n, m)))[0].T for _ in range(count)])
    points = noise(count, n, seed).astype(np.float64)
    return points - np.einsum("tmn,tm->tn", bases, np.einsum("tmn,tn->tm", bases, points)), bases


def test_the_meeting_point_solves_the_normal_equations() -> None:
    feet, bases = subspaces(3, 4, 20)
    shares = np.eye(20) - bases.transpose(0, 2, 1) @ bases
    expected = np.linalg.solve(shares.sum(axis=0), feet.sum(axis=0))
    found = meeting_point(feet, bases)
    assert found.point == pytest.approx(expected)
    assert found.shared == 0


def test_of_several_meeting_points_the_one_of_least_norm_is_taken() -> None:
    feet, bases = subspaces(3, 4, 20)
    bases = bases.copy()
    bases[:, 0] = bases[0, 0]
    for row in range(3):
        bases[row] = np.linalg.qr(bases[row].T)[0].T
        feet[row] -= bases[row].T @ (bases[row] @ feet[row])
    shares = np.eye(20) - bases.transpose(0, 2, 1) @ bases
    expected = np.linalg.pinv(shares.sum(axis=0), rcond=1e-8) @ feet.sum(axis=0)
    found = meeting_point(feet, bases)
    assert found.shared == 1
    assert found.point == pytest.approx(expected, abs=1e-9)


def test_the_common_point_is_not_bettered_nearby() -> None:
    feet, bases = subspaces(3, 4, 20)
    radii = np.sqrt(1 - np.sum(feet**2, axis=1))

    def value(x: np.ndarray) -> float:
        return float(np.sum(feet @ x + radii * np.linalg.norm(bases @ x, axis=1)))

    found = nearest_common_point(feet, bases, np.concatenate([feet, -feet]))
    assert np.linalg.norm(found) == pytest.approx(1)
    rng = np.random.default_rng(1)
    for _ in range(200):
        near = found + 0.05 * rng.standard_normal(20)
        assert value(near / np.linalg.norm(near)) <= value(found) + 1e-9


def test_two_lifts_of_one_descriptor_meet_in_it() -> None:
    stored, exact = same_descriptor(system_of("generator"), lifts=(2,))
    assert number(exact.details["largest_error_where_unique"]) < 1e-5
    assert number(stored.details["largest_error_where_unique"]) < 2e-3
    assert share(stored) == share(exact) == 1
    assert exact.details["templates_that_share_a_decoy"] == 0
    assert not exact.judged


def test_a_small_pool_makes_two_lifts_share_decoys() -> None:
    system = system_of("pool")
    assert isinstance(system.source, DecoyPool)
    few = system.source.subset(np.arange(12))
    narrow = replace(system, source=few, lifter=replace(system.lifter, source=few))
    (_, exact) = same_descriptor(narrow, lifts=(2,))
    assert number(exact.details["templates_that_share_a_decoy"]) > VICTIMS / 2


def test_photos_of_one_person_lead_to_the_person() -> None:
    system = system_of("generator")
    rng = np.random.default_rng(0)
    centres = noise(20, system.templates.n, seed=5)
    photos = []
    for centre in centres:
        rows = centre + 0.35 * noise(6, system.templates.n, seed=int(rng.integers(1 << 30)))
        photos.append((rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32))
    two, five = different_photos(system, photos, lifts=(2, 5, 10))
    assert share(five) > 0.9
    assert number(five.details["cosine_to_truth_mean"]) > number(
        two.details["cosine_to_truth_mean"]
    )
    assert five.details["people"] == 20
    assert five.judged
    (few,) = different_photos(system, photos[:19], lifts=(5,))
    assert not few.judged
    assert "Not judged" in few.assumption
    strangers = [noise(6, system.templates.n, seed=100 + row) for row in range(20)]
    (none,) = different_photos(system, strangers, lifts=(5,))
    assert counts(none)[0] <= 1
