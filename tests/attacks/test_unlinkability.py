import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from attacks.unlinkability import global_d, local_d, unlinkability


def gaussian_scores(shift: float, *, people: int = 150, liftings: int = 6) -> np.ndarray:
    rng = np.random.default_rng(3)
    scores = rng.normal(size=(liftings, people, people))
    own = np.arange(people)
    scores[:, own, own] += shift
    return scores


def test_local_d_is_the_papers_formula_bin_by_bin() -> None:
    genuine, impostor = np.array([0.0, 2.0, 6.0, 12.0]), np.array([30.0, 40.0, 30.0, 0.0])
    expected = []
    for a, b in zip(genuine / 20, impostor / 100, strict=True):
        ratio = np.inf if b == 0 else a / b
        with np.errstate(invalid="ignore"):
            value = 1.0 if np.isinf(ratio) else 2 * ratio / (1 + ratio) - 1
        expected.append(value if ratio > 1 else 0.0)
    np.testing.assert_allclose(local_d(genuine, impostor), expected, atol=1e-12)
    assert global_d(genuine, impostor) == pytest.approx(np.dot(genuine / 20, expected))


def test_d_sys_of_shifted_gaussians_is_the_integral() -> None:
    shift = 1.5

    def density(x: float) -> float:
        a, b = norm.pdf(x, shift), norm.pdf(x)
        return float(a * max(a - b, 0) / (a + b))

    expected = quad(density, -8, 10)[0]
    measured = unlinkability(gaussian_scores(shift), seed=0)
    assert measured.d_sys.value == pytest.approx(expected, abs=0.05)
    assert measured.d_sys.value > measured.null_95
    assert measured.d_sys.ci_low < measured.d_sys.value < measured.d_sys.ci_high


def test_scores_that_tell_nothing_stay_within_the_null() -> None:
    measured = unlinkability(gaussian_scores(0.0), seed=0)
    assert measured.d_sys.value <= measured.null_95
    assert measured.d_sys.value == pytest.approx(measured.null_mean, abs=0.05)
    assert 0 < measured.null_mean < measured.null_95
    assert measured.first_rank < 0.05


def test_rows_and_columns_that_differ_are_no_link() -> None:
    """A shuffle of single scores would take the templates' own levels for a link."""
    rng = np.random.default_rng(0)
    scores = gaussian_scores(0.0, liftings=1)
    scores += 3 * rng.normal(size=(150, 1)) + 3 * rng.normal(size=(1, 150))
    measured = unlinkability(scores, seed=0)
    assert measured.d_sys.value <= measured.null_95
