"""How far scores between templates of two services tell who is the same person: D_sys.

The framework of Gomez-Barrero et al. A histogram of few scores shows structure where there is
none, so the measure is worth nothing without its permutation null, which stands beside it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import Estimate

MOST_BINS = 100
SCORES_PER_BIN = 10
"""Mated scores to a bin, on average, as in the authors' own code."""
PERMUTATIONS = REPLICATES = 500
_INTERVAL = "bootstrap by person, centred"

Array64 = NDArray[np.float64]


@dataclass(frozen=True)
class Unlinkability:
    """D_sys of one linkage score, and what it is on this many scores where nothing links.

    Parameters
    ----------
    d_sys
        0: genuine and impostor scores are alike; 1: they never meet. The interval resamples people.
    null_mean, null_95
        Mean and 95th percentile of D_sys over permutations of who is paired with whom.
    first_rank
        Share of rows whose mate has the highest score of the row: identification at rank 1.
    """

    d_sys: Estimate
    null_mean: float
    null_95: float
    first_rank: float


def local_d(genuine: Array64, impostor: Array64) -> Array64:
    """D(s) from histograms (..., B) of genuine and impostor scores on the same bins; (..., B).

    2 LR / (1 + LR) − 1 where LR > 1 and 0 elsewhere, for even prior odds; 1 where only genuine
    scores fall.

    References
    ----------
    Gomez-Barrero, Galbally, Rathgeb, Busch, "General framework to evaluate unlinkability in
    biometric template protection systems", IEEE TIFS 2018, eq. 6 and 7.
    """
    genuine_share = genuine / np.maximum(genuine.sum(axis=-1, keepdims=True), 1e-300)
    impostor_share = impostor / np.maximum(impostor.sum(axis=-1, keepdims=True), 1e-300)
    # 2 LR / (1 + LR) − 1 = (a − b) / (a + b) for LR = a / b, which needs no division by b = 0.
    total = genuine_share + impostor_share
    difference = np.divide(
        genuine_share - impostor_share, total, out=np.zeros_like(total), where=total > 0
    )
    return np.asarray(np.maximum(difference, 0.0))


def global_d(genuine: Array64, impostor: Array64) -> Array64:
    """D_sys = Σ p(s | genuine) D(s) Δs from histograms (..., B); shape (...)."""
    shares = genuine / np.maximum(genuine.sum(axis=-1, keepdims=True), 1e-300)
    return np.asarray((shares * local_d(genuine, impostor)).sum(axis=-1))


def unlinkability(scores: NDArray[np.floating], *, seed: int) -> Unlinkability:
    """Measure what a linkage score tells.

    ``scores``, (L, V, V), are of template i in one database with template j in another, in each of
    L independent liftings of the same V people; i = j is genuine. The null assigns mates at random,
    the same in all liftings: rows and columns keep what they have in common, which a shuffle of
    single scores would destroy.
    """
    values = np.asarray(scores, dtype=np.float64)
    liftings, people = values.shape[:2]
    rng = np.random.default_rng(seed)
    count = int(np.clip(liftings * people // SCORES_PER_BIN, 2, MOST_BINS))
    edges = np.linspace(values.min(), np.nextafter(values.max(), np.inf), count + 1)
    bin_of = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, count - 1)
    every = np.bincount(bin_of.ravel(), minlength=count).astype(np.float64)

    def histograms(mates: NDArray[np.int64]) -> tuple[Array64, Array64]:
        genuine = np.bincount(bin_of[:, np.arange(people), mates].ravel(), minlength=count)
        return genuine.astype(np.float64), every - genuine

    own = np.arange(people)
    shuffles = [histograms(rng.permutation(people)) for _ in range(PERMUTATIONS)]
    null = global_d(np.stack([m for m, _ in shuffles]), np.stack([n for _, n in shuffles]))
    value = float(global_d(*histograms(own)))
    spread = _bootstrap(bin_of, count, rng)
    low, high = np.quantile(spread - spread.mean(), (0.025, 0.975))
    return Unlinkability(
        d_sys=Estimate(
            value=value,
            ci_low=float(np.clip(value + low, 0.0, value)),
            ci_high=float(np.clip(value + high, value, 1.0)),
            trials=liftings * people,
            interval=_INTERVAL,
        ),
        null_mean=float(null.mean()),
        null_95=float(np.quantile(null, 0.95)),
        first_rank=float((values.argmax(axis=2) == own).mean()),
    )


def _bootstrap(bin_of: NDArray[np.int64], count: int, rng: np.random.Generator) -> Array64:
    """D_sys of resampled people, (REPLICATES,).

    Few scores raise D_sys, and a resample holds fewer different ones, so the replicates lie above
    the value; their spread about their own mean is what is used.
    """
    people = bin_of.shape[1]
    cells = bin_of + count * np.arange(people)[:, None]
    own = np.arange(people)
    # by_row[i, b]: scores of row i in bin b, all liftings, with the mates and apart from them.
    mates = np.bincount(cells[:, own, own].ravel(), minlength=people * count)
    mates = mates.reshape(people, count).astype(np.float64)
    out = np.empty(REPLICATES)
    for index in range(REPLICATES):
        drawn = rng.integers(people, size=people)
        weights = np.bincount(drawn, minlength=people).astype(np.float64)
        pairs = weights[:, None] * weights
        pairs[own, own] = 0.0
        impostor = sum(
            np.bincount(bins.ravel(), weights=pairs.ravel(), minlength=count) for bins in bin_of
        )
        out[index] = global_d(weights @ mates, np.asarray(impostor))
    return out
