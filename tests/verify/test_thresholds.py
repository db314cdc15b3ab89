import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from templates.errors import ContractError
from verify import CalibrationOptions
from verify.thresholds import (
    Genuine,
    Impostors,
    JointTails,
    level_name,
    make_level,
    resolved_targets,
)


def impostors_of(
    similarities: NDArray[np.floating],
    cohort_scores: NDArray[np.floating],
    *,
    trials: int | None = None,
    person_pairs: int = 10**9,
) -> Impostors:
    count = int(np.isfinite(similarities).sum())
    return Impostors(
        similarities=np.asarray(similarities, dtype=np.float32),
        cohort_scores=np.asarray(cohort_scores, dtype=np.float32),
        trials=count if trials is None else trials,
        people=50,
        person_pairs=person_pairs,
        people_of=lambda flat: np.stack([flat % 50, (flat + 1) % 50], axis=1),
        weighted_trials=lambda weights: float(weights.sum()) ** 2 * count / 50**2,
    )


def joint_counts(similarities: NDArray[np.float32], scores: NDArray[np.float32]) -> list[int]:
    """Accepted trials at every marginal rank, by counting ranks one trial at a time."""
    ranks = [
        max(int((similarities >= s).sum()), int((scores >= z).sum()))
        for s, z in zip(similarities, scores, strict=True)
    ]
    return [sum(rank <= k for rank in ranks) for k in range(len(ranks) + 1)]


@given(
    st.lists(st.tuples(st.integers(-9, 9), st.integers(-9, 9)), min_size=1, max_size=40),
    st.sampled_from([0.0, 0.01, 0.1, 0.25, 0.5, 1.0]),
)
def test_joint_threshold_is_the_laxest_common_rank(
    pairs: list[tuple[int, int]], target: float
) -> None:
    values = np.array(pairs, dtype=np.float32) / 4
    tails = JointTails(impostors_of(values[:, 0], values[:, 1]))
    similarity, cohort = tails.for_target(target)
    exact = values.astype(np.float64)
    accepted = int(((exact[:, 0] >= similarity) & (exact[:, 1] >= cohort)).sum())
    counts = joint_counts(values[:, 0], values[:, 1])
    assert accepted == max(count for count in counts if count <= target * len(pairs))


def test_both_thresholds_stand_at_one_marginal_rank() -> None:
    rng = np.random.default_rng(0)
    common = rng.normal(size=40_000)
    similarities = (common + rng.normal(size=40_000)).astype(np.float32)
    scores = (common + rng.normal(size=40_000)).astype(np.float32)
    tails = JointTails(impostors_of(similarities, scores))
    for target in (1e-2, 1e-3):
        similarity, cohort = tails.for_target(target)
        above = [int((similarities >= similarity).sum()), int((scores >= cohort).sum())]
        joint = int(((similarities >= similarity) & (scores >= cohort)).sum())
        assert above[0] == above[1]
        assert joint == round(target * 40_000)
        # Each alone at the target would have halved the joint rate, or worse.
        assert above[0] > 1.5 * joint


def test_cells_that_are_no_trials_count_nowhere() -> None:
    similarities = np.array([0.9, -np.inf, 0.5, 0.1, -np.inf], dtype=np.float32)
    tails = JointTails(impostors_of(similarities, similarities))
    assert tails.for_target(1 / 3)[0] == pytest.approx(0.7)
    assert tails.rank_of(0.5) == 2
    assert tails.at_rank(3)[0] == pytest.approx(0.1)


def test_levels_are_refused_that_the_data_cannot_resolve() -> None:
    scores = np.zeros(9_999)
    kept, refused = resolved_targets(impostors_of(scores, scores), [1e-3, 1e-2])
    assert kept == [1e-2]
    assert "FMR 0.001 is not resolved by 9999 impostor trials" in refused[0]
    few_pairs = impostors_of(scores, scores, trials=10**6, person_pairs=2_999)
    assert resolved_targets(few_pairs, [1e-2, 1e-3])[0] == [1e-2]


def test_level_counts_both_errors_jointly() -> None:
    impostors = impostors_of(np.array([0.9, 0.9, 0.1, 0.1]), np.array([3.0, 1.0, 3.0, 1.0]))
    genuine = Genuine(
        np.array([0.95, 0.95, 0.2], dtype=np.float32),
        np.array([4.0, 1.0, 4.0], dtype=np.float32),
        np.array([0, 1, 2]),
    )
    level = make_level("fmr-1e-2", 1e-2, (0.5, 2.0), impostors, genuine, seed=0)
    assert (level.fmr.errors, level.fmr.trials) == (1, 4)
    assert (level.fnmr.errors, level.fnmr.trials) == (2, 3)


def test_level_names() -> None:
    assert [level_name(10.0**-k) for k in (2, 3, 6)] == ["fmr-1e-2", "fmr-1e-3", "fmr-1e-6"]
    # Rounded to a power of ten, 3e-3 would carry the name of the stricter 1e-3.
    for target in (3e-3, 1.001e-3, 1.0, 10.0, 0.0, -1e-3, float("nan")):
        with pytest.raises(ContractError, match="powers of ten"):
            level_name(target)
        with pytest.raises(ContractError, match="powers of ten"):
            CalibrationOptions(targets=(1e-2, target))
