import numpy as np
import pytest
from scipy.optimize import minimize

from attacks.errors import AuditError
from attacks.second_order import (
    RIDGE,
    Moments,
    drawn_towards,
    likeliest_descriptors,
    second_moment,
)
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import unit

N = 32


def templates_of(
    faces: np.ndarray, decoys: np.ndarray, *, k: int, random: int = 0, count: int = 100
) -> tuple[SubspaceBatch, np.ndarray]:
    """People and decoys with these deviations along the axes, then random directions."""
    rng = np.random.default_rng(5)
    people = unit(rng.normal(size=(count, N)) * faces)
    others = unit(rng.normal(size=(count, k, N)) * decoys)
    noise = rng.uniform(-1, 1, size=(count, random, N))
    directions = np.concatenate([others - people[:, None], noise], axis=1)
    with Keystream.seeded("second order") as stream:
        return SubspaceBatch.through(people, directions, stream=stream), people


def exact(deviations: np.ndarray) -> Moments:
    return Moments.of(np.diag(deviations**2))


def cosines(rows: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ij,ij->i", rows, truth))


FACES = np.linspace(1.0, 0.2, N)
WIDER = np.where(np.arange(N) < N // 2, 1.0, 4.0) * FACES


def test_decoys_that_vary_more_than_faces_give_the_descriptor_away() -> None:
    templates, people = templates_of(FACES, WIDER, k=6)
    guesses = likeliest_descriptors(templates, exact(FACES), exact(WIDER), count=6)
    np.testing.assert_allclose(np.linalg.norm(guesses, axis=1), 1.0, atol=1e-9)
    found = cosines(guesses, people)
    assert np.median(found) > templates.foot_norms.mean() + 0.4
    assert abs(np.median(cosines(guesses, np.roll(people, 1, axis=0)))) < 0.2


def test_decoys_of_the_same_spread_do_not() -> None:
    templates, people = templates_of(FACES, FACES, k=6)
    guesses = likeliest_descriptors(templates, exact(FACES), exact(FACES), count=6)
    assert cosines(guesses, people).mean() < templates.foot_norms.mean() + 0.05


def test_no_point_of_the_span_is_likelier() -> None:
    """Against a general optimiser, on the two densities as they are written."""
    templates, _ = templates_of(FACES, WIDER, k=4, count=5)
    guesses = likeliest_descriptors(templates, exact(FACES), exact(WIDER), count=4)
    of_faces, of_decoys = (
        np.diag(1 / (spread**2 + RIDGE * (spread**2).max())) for spread in (FACES, WIDER)
    )

    def value(x: np.ndarray) -> float:
        x = x / np.linalg.norm(x)
        return float(np.log(x @ of_decoys @ x) - np.log(x @ of_faces @ x))

    rng = np.random.default_rng(0)
    for row, template in enumerate(templates):
        span = np.concatenate([template.foot[None], template.basis]).astype(np.float64)
        span = np.linalg.qr(span.T)[0].T
        best = max(
            -minimize(lambda c, span=span: -value(c @ span), rng.normal(size=5)).fun
            for _ in range(10)
        )
        assert value(guesses[row]) == pytest.approx(best, abs=2e-3)
        inside = span.T @ (span @ guesses[row])
        np.testing.assert_allclose(inside, guesses[row], atol=1e-5)


def test_random_directions_are_removed() -> None:
    """Faces hardly vary along a third of the axes, where random directions stand out."""
    thin = np.where(np.arange(N) < 20, 1.0, 1e-2)
    alone, people = templates_of(thin, thin, k=0, random=6)
    guesses = likeliest_descriptors(alone, exact(thin), None, count=0)
    assert cosines(guesses, people).min() > 0.98
    wider = np.where(np.arange(N) < 10, 1.0, 4.0) * thin
    mixed, people = templates_of(thin, wider, k=3, random=3)
    stripped = likeliest_descriptors(mixed, exact(thin), exact(wider), count=3)
    assert cosines(stripped, people).mean() > mixed.foot_norms.mean() + 0.3


def test_few_faces_are_drawn_towards_the_decoys() -> None:
    rng = np.random.default_rng(0)
    prior = np.diag(WIDER**2)
    few, many = rng.normal(size=(8, N)) * FACES, rng.normal(size=(200_000, N)) * FACES
    assert np.linalg.matrix_rank(second_moment(few)) == 8
    assert np.linalg.eigvalsh(drawn_towards(few, prior)).min() > 0.7 * (WIDER**2).min()
    np.testing.assert_allclose(drawn_towards(many, prior), np.diag(FACES**2), atol=0.02)


def test_decoys_of_unknown_spread_are_refused() -> None:
    templates, _ = templates_of(FACES, FACES, k=2, count=2)
    with pytest.raises(AuditError, match="unknown spread"):
        likeliest_descriptors(templates, exact(FACES), None, count=2)
    with pytest.raises(AuditError, match="no spread"):
        Moments.of(np.zeros((N, N)))
