from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from attacks.stored.intersection import (
    meeting_point,
    nearest_common_point,
    nearest_common_points,
    same_descriptor,
)
from templates.decoys import DecoyPool
from tests.attacks.stored.systems import VICTIMS, noise, number, share, system_of


def subspaces(count: int, m: int, n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    bases = np.stack([np.linalg.qr(rng.standard_normal((n, m)))[0].T for _ in range(count)])
    points = noise(count, n, seed).astype(np.float64)
    return points - np.einsum("tmn,tm->tn", bases, np.einsum("tmn,tn->tm", bases, points)), bases


@pytest.mark.parametrize("m", [4, 9])
def test_the_meeting_point_solves_the_normal_equations(m: int) -> None:
    feet, bases = subspaces(3, m, 20)
    shares = np.eye(20) - bases.transpose(0, 2, 1) @ bases
    expected = np.linalg.solve(shares.sum(axis=0), feet.sum(axis=0))
    found = meeting_point(feet, bases)
    assert found.point == pytest.approx(expected)
    assert found.shared == 0


@pytest.mark.parametrize("m", [4, 9])
def test_of_several_meeting_points_the_one_of_least_norm_is_taken(m: int) -> None:
    feet, bases = subspaces(3, m, 20)
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


def test_the_nearest_points_are_as_near_as_a_search_finds() -> None:
    """Middle of the nearest unit points of two templates, found by descent from random starts."""
    system = system_of("generator")
    old = system.templates[:3]
    new = system.lift(system.victims.fresh[:3], "test of nearest points")
    middles = nearest_common_points([old, new])
    rng = np.random.default_rng(0)
    for index in range(3):
        p, d = old.feet[index].astype(float), old.bases[index].astype(float)
        q, e = new.feet[index].astype(float), new.bases[index].astype(float)
        s, t = old.radii[index], new.radii[index]

        def gap(angles: np.ndarray, p=p, d=d, q=q, e=e, s=s, t=t) -> float:
            u, v = angles[: len(d)], angles[len(d) :]
            x = p + s * (u / np.linalg.norm(u)) @ d
            return float(np.linalg.norm(x - q - t * (v / np.linalg.norm(v)) @ e))

        found = min(minimize(gap, rng.normal(size=old.m + new.m)).fun for _ in range(8))
        start = np.concatenate([d @ middles[index], e @ middles[index]])
        assert gap(start) <= found + 0.02
