"""The ten-fold protocol of LFW: best accuracy on nine folds, applied to the tenth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.errors import ContractError

FOLDS = 10


class Pairs(NamedTuple):
    """Verification trials, each (P,): two photos, whether they show one person, and the fold."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    same: NDArray[np.bool_]
    folds: NDArray[np.int64]  # 0 … 9


@dataclass(frozen=True)
class TenFold:
    """Accuracies and thresholds of the folds, in fold order."""

    accuracies: tuple[float, ...]
    thresholds: tuple[float, ...]

    @property
    def accuracy_mean(self) -> float:
        """Mean accuracy over the folds."""
        return float(np.mean(self.accuracies))

    @property
    def accuracy_std(self) -> float:
        """Standard deviation over the folds, as the literature prints it (divisor: folds)."""
        return float(np.std(self.accuracies))

    @property
    def threshold_mean(self) -> float:
        """Mean of the thresholds that the folds chose."""
        return float(np.mean(self.thresholds))


GRID = np.arange(0, 400) / 100
"""The literature's thresholds for raw embeddings: squared L2 distances 0 … 3.99."""

Search = Callable[[NDArray[np.float64], NDArray[np.bool_]], float]


def best_threshold(similarities: ArrayLike, same: ArrayLike) -> float:
    """Threshold of best accuracy, by an exact sweep over the observed similarities.

    Of equally good thresholds the highest is taken, which accepts the fewest. It lies halfway
    between two observed similarities.
    """
    scores = np.asarray(similarities, dtype=np.float64)
    truth = np.asarray(same, dtype=bool)
    order = np.argsort(-scores, kind="stable")
    ranked, genuine = scores[order], truth[order]
    # right[k]: correct decisions when the k highest are accepted.
    right = np.concatenate([[0], np.cumsum(np.where(genuine, 1, -1))]) + np.count_nonzero(~truth)
    # A cut inside a run of equal similarities cannot be made by a threshold.
    possible = np.concatenate([[True], ranked[1:] < ranked[:-1], [True]])
    cut = int(np.argmax(np.where(possible, right, -1)))
    if cut == 0:
        return float(np.nextafter(ranked[0], np.inf))
    if cut == len(ranked):
        return float(ranked[-1])
    return float((ranked[cut] + ranked[cut - 1]) / 2)


def best_grid_threshold(similarities: ArrayLike, same: ArrayLike) -> float:
    """Threshold of best accuracy on the literature's grid; for raw embeddings only.

    The grid is of squared L2 distances t = 0, 0.01 … 3.99; a pair matches where its distance is
    *below* t; the first best t wins (InsightFace's ``verification.py``). The result is the lowest
    similarity with a distance 2 − 2·similarity below t.
    """
    scores = np.asarray(similarities, dtype=np.float64)
    truth = np.asarray(same, dtype=bool)
    distances = 2 - 2 * scores
    genuine, impostor = np.sort(distances[truth]), np.sort(distances[~truth])
    right = np.searchsorted(genuine, GRID) + impostor.size - np.searchsorted(impostor, GRID)
    return float(np.nextafter(1 - GRID[np.argmax(right)] / 2, np.inf))


def ten_fold(
    similarities: ArrayLike, same: ArrayLike, folds: ArrayLike, *, search: Search = best_threshold
) -> TenFold:
    """Run the protocol on the similarity, truth and fold (0 … 9) of every pair, each (P,)."""
    scores = np.asarray(similarities, dtype=np.float64)
    truth = np.asarray(same, dtype=np.bool_)
    numbers = np.asarray(folds, dtype=np.int64)
    accuracies, thresholds = [], []
    for fold in range(FOLDS):
        held_out = numbers == fold
        threshold = search(scores[~held_out], truth[~held_out])
        accuracies.append(float(np.mean((scores[held_out] >= threshold) == truth[held_out])))
        thresholds.append(threshold)
    return TenFold(accuracies=tuple(accuracies), thresholds=tuple(thresholds))


def random_pairs(
    person_of: NDArray[np.int64], *, rng: np.random.Generator, most_per_class: int = 3000
) -> Pairs:
    """Draw balanced pairs of the photos of people, (N,).

    Genuine pairs are distinct photos of one person, impostor pairs photos of two; as many of
    either, spread over the folds in turn.
    """
    groups = [np.flatnonzero(person_of == person) for person in np.unique(person_of)]
    genuine = [
        (int(photos[i]), int(photos[j]))
        for photos in groups
        # A person with hundreds of photos would fill the set alone: 12 photos give 66 pairs.
        for photos in [photos if len(photos) <= 12 else rng.choice(photos, 12, replace=False)]
        for i, j in zip(*np.triu_indices(len(photos), k=1), strict=True)
    ]
    if len(genuine) < FOLDS or len(groups) < 2:
        raise ContractError(
            f"the ten-fold protocol needs at least {FOLDS} pairs of photos of one person, and two "
            f"people; seen {len(genuine)} pairs and {len(groups)} people: add photos, or calibrate "
            "under protocol fmr"
        )
    count = min(most_per_class, len(genuine))
    chosen = [genuine[k] for k in rng.permutation(len(genuine))[:count]]
    impostor: list[tuple[int, int]] = []
    while len(impostor) < count:
        i, j = map(int, rng.integers(len(person_of), size=2))
        if person_of[i] != person_of[j]:
            impostor.append((i, j))
    first, second = np.array(chosen + impostor, dtype=np.int64).T
    same = np.arange(2 * count) < count
    return Pairs(first, second, same, np.arange(2 * count) % count % FOLDS)
