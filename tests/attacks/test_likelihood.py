from dataclasses import replace

import numpy as np
import pytest

from attacks.likelihood import (
    find_least_decoy_like,
    likeliest_guesses,
    likeliest_points,
    precision,
    simulate_unlimited,
)
from attacks.outcomes import GENERATED, AttackOutcome, Scheme
from attacks.population import Population
from attacks.system import System
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.attacks.conftest import small_system
from tests.verify.synthetic import unit

N, M = 32, 5


def lifted(
    faces: np.ndarray, decoys: np.ndarray, *, count: int = 80
) -> tuple[SubspaceBatch, np.ndarray, np.ndarray]:
    """People spread as ``faces`` along the axes, decoys as ``decoys``."""
    rng = np.random.default_rng(2)
    people = unit(rng.normal(size=(count, N)) * faces)
    others = unit(rng.normal(size=(count, M, N)) * decoys)
    with Keystream.seeded("likelihood") as stream:
        batch = SubspaceBatch.through(people, others - people[:, None], stream=stream)
    return batch, people, others


def reported(system: System) -> list[AttackOutcome]:
    return find_least_decoy_like(system, likeliest_guesses(system), kind="a test")


def cosines(rows: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ij,ij->i", rows, truth))


def test_decoys_of_another_kind_give_the_descriptor_away() -> None:
    """Along half of the axes only the descriptor has a part, so its coefficient is maximised."""
    narrow = np.where(np.arange(N) < N // 2, 1.0, 1e-3)
    templates, people, decoys = lifted(np.ones(N), narrow)
    form = precision(np.random.default_rng(0).normal(size=(4000, N)) * narrow, shrinkage=1e-7)
    guesses = likeliest_points(templates, form)
    np.testing.assert_allclose(np.linalg.norm(guesses, axis=1), 1.0, atol=1e-5)
    for index in range(len(templates)):
        points = np.concatenate([people[index : index + 1], decoys[index]]).astype(float)
        part = np.linalg.pinv(points)[:, 0]  # x @ part: how much of x is the descriptor
        best = points.T @ np.linalg.lstsq(points.T, part, rcond=None)[0]
        assert abs(guesses[index] @ best) / np.linalg.norm(best) > 0.95
    assert cosines(guesses, people).mean() > templates.foot_norms.mean() + 0.3


def test_decoys_of_the_same_kind_do_not() -> None:
    templates, people, _ = lifted(np.ones(N), np.ones(N))
    rows = np.random.default_rng(0).normal(size=(2, 4000, N))
    guesses = likeliest_points(templates, precision(rows[0]) - precision(rows[1]))
    assert cosines(guesses, people).mean() < templates.foot_norms.mean()


def test_no_unit_point_of_the_span_is_likelier() -> None:
    templates, _, _ = lifted(np.ones(N), np.ones(N), count=3)
    form = precision(np.random.default_rng(1).normal(size=(500, N)) * np.linspace(0.2, 1, N))
    best = likeliest_points(templates, form)
    reached = np.einsum("tn,nk,tk->t", best, form, best)
    rng = np.random.default_rng(3)
    for index, template in enumerate(templates):
        span = np.concatenate([template.foot[None], template.basis]).astype(np.float64)
        rows = unit(rng.normal(size=(20_000, M + 1)) @ span).astype(np.float64)
        assert np.einsum("tn,nk,tk->t", rows, form, rows).max() <= reached[index] + 1e-6
        assert np.linalg.norm(best[index]) == pytest.approx(1.0)
        outside = best[index] - span.T @ np.linalg.lstsq(span.T, best[index], rcond=None)[0]
        assert np.linalg.norm(outside) < 1e-6


def test_a_generator_of_another_kind_than_the_victims_is_seen_through(
    small_population: Population,
) -> None:
    """Decoys vary along half of the axes, people along all: the same, as an audit reports it."""
    n = small_population.attacker.shape[1]
    rng = np.random.default_rng(4)
    narrow = np.where(np.arange(n) < n // 2, 1.0, 0.02)
    other = DecoyGenerator.fit(unit(rng.normal(size=(600, n)) * narrow))
    system = small_system(small_population, Scheme("adversarial", GENERATED, 6), other)
    *rows, control = reported(system)
    for row in rows:
        assert row.measured.value > 0.9, row.variant
        assert float(str(row.details["cosine_to_truth_mean"])) > 0.8
        assert row.judged
        assert row.details["faces_from"] == "a test"
    assert control.variant == "photos of other people"
    assert control.measured.value <= 0.1
    assert not control.judged


def test_guesses_are_what_the_outcomes_report(system: System) -> None:
    guesses = likeliest_guesses(system)
    for row in find_least_decoy_like(system, guesses, kind="a test")[:-1]:
        mean = cosines(guesses[row.variant], system.victims.enrolled).mean()
        assert float(str(row.details["cosine_to_truth_mean"])) == pytest.approx(mean, abs=1e-6)


def test_templates_of_strangers_give_nothing(system: System, strangers: np.ndarray) -> None:
    noise = replace(system, templates=system.lift(strangers, "noise"))
    for row in reported(noise):
        assert row.measured.value <= 0.1


def test_random_lifting_gives_the_descriptor_to_who_knows_faces(weak_system: System) -> None:
    (with_faces, control) = reported(weak_system)
    assert with_faces.variant == f"{len(weak_system.attacker)} faces"
    # These synthetic faces vary along all axes, from which random directions hardly stand out.
    assert with_faces.measured.value > 0.4
    assert control.measured.value <= 0.1


def test_the_attacker_without_limit_is_simulated(system: System, weak_system: System) -> None:
    measured = reported(system)
    few, many = (
        simulate_unlimited(system, fitted_to=count, kind="a test", measured=measured)[0]
        for count in (100, 4000)
    )
    assert few.measured.value > many.measured.value
    assert few.judged
    assert few.details["faces"] == "unlimited"
    assert few.details["generator_fitted_to"] == 100
    assert few.details["extrapolated_from_finite"] is None  # one number of faces only
    assert simulate_unlimited(weak_system, fitted_to=100, kind="a test", measured=[]) == []
    (estimate,) = simulate_unlimited(system, fitted_to=None, kind="a test", measured=measured)
    assert not estimate.judged
    assert estimate.details["generator_fitted_to"] is None
    assert "the decoy generator as it is" in estimate.assumption
    # These decoys are of the people's kind, and were fitted to thousands of such faces.
    assert estimate.measured.value < few.measured.value
