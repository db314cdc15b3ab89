"""How far FNMR at FMR could have come out otherwise: replicates that resample people or pairs.

Pairs of one benchmark share people, so the people are resampled: one drawn w times weighs w in
its genuine pairs, and a pair of two people weighs the product of their weights (bootstrap by
subject, ISO/IEC 19795-1). A replicate sets its own threshold, so the spread of the threshold is
in the interval too. All runs of a set see the same draws of people, so that their mean can be
taken replicate by replicate.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.material import Material

REPLICATES = 400
GRID_POINTS = 49

Floats = NDArray[np.float64]
Interval = Literal["subject-bootstrap", "pair-bootstrap"]


@dataclass(frozen=True, eq=False, repr=False)
class Weights:
    """Weights of the pairs in every replicate.

    Parameters
    ----------
    genuine : (R, G) float64
    impostor : (R, I) float64
    interval
        What was resampled.
    """

    genuine: Floats
    impostor: Floats
    interval: Interval


def draw_weights(material: Material, *, seed: int, replicates: int = REPLICATES) -> Weights:
    """Draw people with replacement; pairs, where the set does not name people.

    Replicates without any genuine or impostor pair are left out.
    """
    generator = np.random.default_rng(seed)
    same = material.same
    interval: Interval
    if material.people is None:
        interval = "pair-bootstrap"
        total = len(same)
        weights = generator.multinomial(total, np.full(total, 1 / total), replicates).astype(float)
    else:
        interval = "subject-bootstrap"
        first = material.people[material.first]
        second = material.people[material.second]
        present, places = np.unique(np.concatenate([first, second]), return_inverse=True)
        count = len(present)
        drawn = generator.multinomial(count, np.full(count, 1 / count), replicates).astype(float)
        one, two = np.split(places, 2)
        weights = drawn[:, one] * np.where(one == two, 1.0, drawn[:, two])
    genuine, impostor = weights[:, same], weights[:, ~same]
    whole = (genuine.sum(axis=1) > 0) & (impostor.sum(axis=1) > 0)
    return Weights(genuine[whole], impostor[whole], interval)


def fmr_grid(impostor_pairs: int) -> Floats:
    """FMR values of curves: from the least that the pairs resolve (3 / trials) to 1."""
    return np.geomspace(min(1.0, 3 / impostor_pairs), 1.0, GRID_POINTS)


def fnmr_replicates(
    mated: Floats, non_mated: Floats, weights: Weights, fmrs: Floats
) -> NDArray[np.float32]:
    """FNMR at FMR ≤ each of ``fmrs`` in every replicate.

    Returns
    -------
    ndarray of float32, shape (R, len(fmrs))
    """
    curve = _Operating(mated, non_mated)
    out = np.empty((len(weights.genuine), len(fmrs)), dtype=np.float32)
    genuine = weights.genuine[:, curve.genuine_order]
    impostor = weights.impostor[:, curve.impostor_order]
    for row, (mine, theirs) in enumerate(zip(genuine, impostor, strict=True)):
        out[row] = curve.fnmr(mine, theirs, fmrs)
    return out


def fnmr_curve(mated: Floats, non_mated: Floats, fmrs: Floats) -> Floats:
    """FNMR at FMR ≤ each of ``fmrs`` on the trials as they are."""
    curve = _Operating(mated, non_mated)
    return curve.fnmr(np.ones(mated.size), np.ones(non_mated.size), fmrs)


class _Operating:
    """Trials in order, with the threshold that accepts the k most alike impostor pairs, all k."""

    def __init__(self, mated: Floats, non_mated: Floats) -> None:
        self.genuine_order = np.argsort(mated, kind="stable")
        self.impostor_order = np.argsort(-non_mated, kind="stable")
        ranked = non_mated[self.impostor_order]
        # To accept k impostor pairs and reject the next, cut halfway between the two.
        cuts = np.empty(ranked.size + 1)
        cuts[0] = np.nextafter(ranked[0], np.inf)
        cuts[1:-1] = (ranked[:-1] + ranked[1:]) / 2
        # Halfway between neighbours may round to the lower one, which would accept it.
        cuts[1:-1] = np.where(cuts[1:-1] > ranked[1:], cuts[1:-1], ranked[:-1])
        cuts[-1] = ranked[-1]
        # A cut inside a run of equal similarities cannot be made: take the one before the run.
        tied = np.concatenate([[False], ranked[1:] == ranked[:-1], [False]])
        self._possible = np.maximum.accumulate(np.where(tied, 0, np.arange(tied.size)))
        self._missed = np.searchsorted(mated[self.genuine_order], cuts, side="left")

    def fnmr(self, genuine: Floats, impostor: Floats, fmrs: Floats) -> Floats:
        """FNMR under weights that are given in the two orders."""
        accepted = np.concatenate([[0.0], np.cumsum(impostor)])
        # Sums of weights are exact; only the product with a target needs room for rounding.
        allowed = fmrs * accepted[-1] * (1 + 1e-12)
        k = np.searchsorted(accepted, allowed, side="right") - 1
        below = np.concatenate([[0.0], np.cumsum(genuine)])
        return np.asarray(below[self._missed[self._possible[k]]] / below[-1])
