import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri
from scipy.stats import binomtest

from verify import metrics

scores = st.lists(st.integers(-6, 6).map(lambda k: k / 4), min_size=1, max_size=40)


@pytest.mark.parametrize(("errors", "trials"), [(0, 1), (0, 3000), (3, 160), (50, 100), (7, 7)])
def test_wilson_agrees_with_scipy(errors: int, trials: int) -> None:
    expected = binomtest(errors, trials).proportion_ci(confidence_level=0.95, method="wilson")
    assert metrics.wilson(errors, trials) == pytest.approx((expected.low, expected.high), abs=1e-12)


@given(scores, st.floats(0, 1))
def test_threshold_is_the_laxest_that_holds_the_target(values: list[float], target: float) -> None:
    threshold = metrics.threshold_at_fmr(values, target)
    # Brute force: the counts that any threshold can accept, and the largest within the target.
    possible = {0} | {sum(v >= value for v in values) for value in values}
    best = max(count for count in possible if count / len(values) <= target)
    assert sum(value >= threshold for value in values) == best


def test_threshold_of_the_tail_is_that_of_all() -> None:
    values = np.random.default_rng(0).normal(size=5000)
    tail = np.sort(values)[-200:]
    whole = metrics.threshold_at_fmr(values, 0.01)
    assert metrics.threshold_at_fmr(tail, 0.01, trials=5000) == whole
    cells = np.concatenate([values, np.full(50, -np.inf)])
    assert metrics.threshold_at_fmr(cells, 0.01, trials=5000) == whole
    with pytest.raises(ValueError, match="outnumber"):
        metrics.threshold_at_fmr(tail, 0.05, trials=5000)


def test_threshold_separates_float32_neighbours() -> None:
    low = np.float32(0.4)
    high = np.nextafter(low, np.float32(1))
    values = np.array([low] * 9 + [high], dtype=np.float32)
    threshold = metrics.threshold_at_fmr(values, 0.1)
    assert np.count_nonzero(values >= threshold) == 1


@given(st.floats(0, 1), st.integers(1, 5000))
def test_most_errors_is_the_largest_count_within_the_target(target: float, trials: int) -> None:
    count = metrics.most_errors(target, trials)
    assert count / trials <= target
    assert (count + 1) / trials > target


def test_equal_error_rate_of_two_normals() -> None:
    # N(0, 1) against N(2, 1): errors are equal at 1, where both are Φ(-1).
    quantiles = (np.arange(20_000) + 0.5) / 20_000
    rate = metrics.equal_error_rate(ndtri(quantiles) + 2, ndtri(quantiles))
    assert rate == pytest.approx(0.158655, abs=1e-4)


def naive_replicates(errors: np.ndarray, trials: np.ndarray, seed: int) -> list[float]:
    """Bootstrap of people by listing every trial of every drawn copy of a person."""
    people = len(trials)
    rng = np.random.default_rng(seed)
    rates = []
    for _ in range(300):
        drawn = rng.integers(people, size=people)
        bad = good = 0
        for a in drawn:
            for b in drawn:
                if a != b:
                    bad += errors[a, b]
                    good += trials[a, b]
        rates.append(bad / good)
    return rates


def test_subject_bootstrap_agrees_with_a_naive_one() -> None:
    rng = np.random.default_rng(2)
    people = 12
    trials = np.full((people, people), 4)
    np.fill_diagonal(trials, 0)
    errors = np.zeros((people, people), dtype=int)
    errors[3, :] = 2  # one wolf makes the errors of a person cling together
    errors[3, 3] = 0
    errors += rng.integers(0, 2, size=errors.shape) * (trials > 0)
    listed = np.array([[a, b] for a, b in np.ndindex(errors.shape) for _ in range(errors[a, b])])
    rate = metrics.subject_bootstrap(
        listed,
        people=people,
        trials=int(trials.sum()),
        weighted_trials=lambda weights: float(weights @ trials @ weights),
        replicates=300,
        seed=9,
    )
    low, high = np.percentile(naive_replicates(errors, trials, seed=9), [2.5, 97.5])
    wilson = metrics.wilson(int(errors.sum()), int(trials.sum()))
    assert (rate.ci_low, rate.ci_high) == pytest.approx((low, high))
    assert rate.ci_low < wilson[0]
    assert rate.ci_high > wilson[1]
    assert rate.interval == "subject-bootstrap"


def test_subject_bootstrap_weighs_a_trial_within_one_person_once() -> None:
    # 30 people, one of them fails all of its 3 genuine trials, the others none of theirs.
    rate = metrics.subject_bootstrap(
        np.array([[4, 4]] * 3),
        people=30,
        trials=90,
        weighted_trials=lambda weights: 3 * float(weights.sum()),
    )
    drawn = np.random.default_rng(1).poisson(1.0, 20_000) * 3 / 90
    assert rate.ci_high == pytest.approx(np.percentile(drawn, 97.5), abs=0.02)
    assert rate.value == pytest.approx(1 / 30)
