import numpy as np
import pytest
from scipy.optimize import minimize

from attacks.outcomes import AuditError
from attacks.second_order import (
    RIDGE,
    Moments,
    as_far_as_faces,
    decoy_moment,
    drawn_towards,
    likeliest_embeddings,
    moment_on_sphere,
    second_moment,
)
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import make_generator, make_pool, unit

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
    stream = Keystream.seeded("second order")
    return SubspaceBatch.through(people, directions, stream=stream), people


def exact(deviations: np.ndarray) -> Moments:
    return Moments.of(np.diag(deviations**2))


def cosines(rows: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.asarray(np.einsum("ij,ij->i", rows, truth))


FACES = np.linspace(1.0, 0.2, N)
WIDER = np.where(np.arange(N) < N // 2, 1.0, 4.0) * FACES


def test_decoys_that_vary_more_than_faces_give_the_embedding_away() -> None:
    templates, people = templates_of(FACES, WIDER, k=6)
    guesses = likeliest_embeddings(templates, exact(FACES), exact(WIDER))
    np.testing.assert_allclose(np.linalg.norm(guesses, axis=1), 1.0, atol=1e-9)
    found = cosines(guesses, people)
    assert np.median(found) > templates.foot_norms.mean() + 0.4
    assert abs(np.median(cosines(guesses, np.roll(people, 1, axis=0)))) < 0.2


def test_decoys_of_the_same_spread_do_not() -> None:
    templates, people = templates_of(FACES, FACES, k=6)
    guesses = likeliest_embeddings(templates, exact(FACES), exact(FACES))
    assert cosines(guesses, people).mean() < templates.foot_norms.mean() + 0.05


def test_no_point_of_the_span_is_likelier() -> None:
    """Against a general optimiser, on the two densities as they are written."""
    templates, _ = templates_of(FACES, WIDER, k=4, count=5)
    guesses = likeliest_embeddings(templates, exact(FACES), exact(WIDER))
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


def test_random_directions_stand_out_where_faces_hardly_vary() -> None:
    thin = np.where(np.arange(N) < 20, 1.0, 1e-2)
    alone, people = templates_of(thin, thin, k=0, random=6)
    guesses = likeliest_embeddings(alone, exact(thin), exact(thin).with_sphere(0.0))
    assert cosines(guesses, people).min() > 0.98
    wider = np.where(np.arange(N) < 10, 1.0, 4.0) * thin
    mixed, people = templates_of(thin, wider, k=3, random=3)
    guesses = likeliest_embeddings(mixed, exact(thin), exact(wider).with_sphere(0.5))
    assert cosines(guesses, people).mean() > mixed.foot_norms.mean() + 0.3


def test_few_faces_are_drawn_towards_the_decoys() -> None:
    rng = np.random.default_rng(0)
    prior = np.diag(WIDER**2)
    few, many = rng.normal(size=(8, N)) * FACES, rng.normal(size=(200_000, N)) * FACES
    assert np.linalg.matrix_rank(second_moment(few)) == 8
    assert np.linalg.eigvalsh(drawn_towards(few, prior)).min() > 0.7 * (WIDER**2).min()
    np.testing.assert_allclose(drawn_towards(many, prior), np.diag(FACES**2), atol=0.02)


def test_the_moment_of_normalised_draws_is_that_of_many_draws() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(8, 8)) * np.linspace(1.0, 0.1, 8)
    mean = rng.normal(size=8)
    drawn = unit(mean + rng.normal(size=(400_000, 8)) @ root.T)
    np.testing.assert_allclose(
        moment_on_sphere(mean, root @ root.T), second_moment(drawn), atol=4e-3
    )
    with pytest.raises(AuditError, match="no spread"):
        moment_on_sphere(np.zeros(4), np.zeros((4, 4)))


@pytest.mark.parametrize("source", [make_generator(), make_pool()])
def test_the_moment_of_decoys_is_that_of_what_is_drawn(source: object) -> None:
    generator = getattr(source, "fitted", source)
    stream = Keystream.seeded("moment of decoys")
    drawn = generator.draw(1, 60_000, stream=stream)[0]
    np.testing.assert_allclose(decoy_moment(source), second_moment(drawn), atol=2e-3)


def test_people_are_as_far_from_decoys_as_faces_are_without_their_sampling_error() -> None:
    """Of decoys that fit, few faces seem to differ by what only their number explains."""
    rng = np.random.default_rng(2)
    decoys = Moments.of(np.eye(N) / N)

    def distance(moment: np.ndarray) -> float:
        return float(np.linalg.norm(N * moment - np.eye(N)))

    fitting, other = unit(rng.normal(size=(200, N))), unit(rng.normal(size=(200, N)) * FACES)
    true = distance(second_moment(unit(rng.normal(size=(400_000, N)) * FACES)))
    assert distance(as_far_as_faces(fitting, decoys)) < 0.5 * distance(second_moment(fitting))
    assert distance(as_far_as_faces(other, decoys)) == pytest.approx(true, rel=0.1)
