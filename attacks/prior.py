"""What an attacker learns from templates of its own before it asks a service about another's.

It knows how templates are lifted. It lifts faces of its own, and sees how the scores of two
probes go together over templates, and which probes pass often.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.recovery import fmr_of
from attacks.system import System
from templates.distances import Metric, pairwise_distances, similarity
from templates.space.subspace import SubspaceBatch

PRIOR_TEMPLATES = 400
MOST_FACES = 1500
_NOISE = 0.002

Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Prior:
    """What the attacker knows before it asks.

    Parameters
    ----------
    faces : (A, n) float64
        Its faces, in the order that decisions only suggest.
    mean : (n,) float64
        Mean of all faces.
    axes : (n, n) float64
        Square root of the faces' second moment, symmetric.
    trend : (3,) float64
        Mean score of a probe e over templates: ``trend @ [1, e·mean, ‖axes e‖²]``.
    kernel : (2,) float64
        Covariance of the scores of e and f over templates: ``kernel @ [k, k²]``, with
        k = (axes e)·(axes f). The first is of ``e·p``, the second of ``‖D e‖²``.
    noise
        Added to the variance of every score: what the two terms leave unexplained. Much less than
        the residual of the fit, which is no noise but what they miss of a smooth function.
    """

    faces: Array64
    mean: Array64
    axes: Array64
    trend: Array64
    kernel: Array64
    noise: float


def learn_prior(
    faces: NDArray[np.floating], templates: SubspaceBatch, *, rate_of_chance: float
) -> Prior:
    """Learn from templates that the attacker lifted from faces of its own.

    Parameters
    ----------
    faces : (A, n) floating
        Unit rows. The last ``len(templates)`` were lifted.
    templates : SubspaceBatch of R
    rate_of_chance
        The level's FMR, as far as the attacker knows: how rare an acceptance is.
    """
    points = np.asarray(faces, dtype=np.float64)
    mean = points.mean(axis=0)
    values, vectors = np.linalg.eigh(points.T @ points / len(points))
    axes = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    strangers = points[: max(1, len(points) - len(templates))][:MOST_FACES]
    distances = pairwise_distances(strangers.astype(np.float32), templates, metric=Metric.SPHERICAL)
    scores = np.asarray(similarity(distances), dtype=np.float64)
    inner = strangers @ axes
    features = np.stack([np.ones(len(inner)), strangers @ mean, (inner**2).sum(axis=1)], axis=1)
    trend = np.linalg.lstsq(features, scores.mean(axis=1), rcond=None)[0]
    centred = scores - scores.mean(axis=1, keepdims=True)
    some = slice(0, 400)
    covariance = centred[some] @ centred[some].T / (scores.shape[1] - 1)
    gram = inner[some] @ inner[some].T
    terms = np.stack([gram.ravel(), gram.ravel() ** 2], axis=1)
    kernel = np.maximum(np.linalg.lstsq(terms, covariance.ravel(), rcond=None)[0], 0)
    order = _cover(scores, rate_of_chance)
    return Prior(
        faces=strangers[order],
        mean=mean,
        axes=axes,
        trend=trend,
        kernel=kernel,
        noise=float(_NOISE * np.diagonal(covariance).mean()),
    )


def _cover(scores: Array64, chance: float) -> NDArray[np.int64]:
    """Order of probes by how many of the attacker's templates each opens that none before it does.

    Greedy set cover. Scores are standardised per probe, over the templates, as the decision
    does; a pair counts where it is among the highest, of twice the share of chance so that the
    counts are not too few to choose by.
    """
    spread = np.maximum(scores.std(axis=1, keepdims=True), 1e-9)
    z = (scores - scores.mean(axis=1, keepdims=True)) / spread
    opens = z >= np.quantile(z, 1 - min(2 * chance, 0.5))
    order: list[int] = []
    left = np.ones(scores.shape[1], dtype=bool)
    free = np.ones(len(scores), dtype=bool)
    while free.any() and left.any():
        gains = np.where(free, opens[:, left].sum(axis=1), -1)
        best = int(np.argmax(gains))
        if gains[best] <= 0:
            break
        order.append(best)
        free[best] = False
        left &= ~opens[best]
    rest = np.flatnonzero(free)
    peaks = np.sort(z[rest], axis=1)[:, -5:].mean(axis=1)
    return np.concatenate([np.asarray(order, dtype=np.int64), rest[np.argsort(-peaks)]])


def attacker_prior(system: System) -> Prior:
    """Learn the prior of the system's attacker, from templates of some of its faces."""
    count = min(PRIOR_TEMPLATES, len(system.attacker) // 2)
    if count < 2:
        raise AuditError("a prior is learnt on faces of four people or more")
    templates = system.lift(system.attacker[-count:], "rehearsal of a climb")
    return learn_prior(system.attacker, templates, rate_of_chance=fmr_of(system.level))
