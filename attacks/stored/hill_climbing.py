"""Getting accepted by repeated probes, with the right to see the service's scores.

The climber learns from templates of its own before it asks, so that every answer counts: it knows
how templates are lifted, lifts faces of its own, and sees how the scores of two probes go together
over templates. It uses no other template than the one that it attacks.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Hits, attack
from attacks.bed import Testbed
from attacks.decisions import fmr_of, score
from attacks.errors import AuditError
from attacks.outcomes import Knowledge, Property
from templates.distances import Metric, pairwise_distances, similarity
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch

LOCKOUTS = (5, 50)
"""Consecutive failures after which a service delays, and locks (NIST SP 800-63B)."""
OWN_TEMPLATES = 400
_ASCENT_STEPS = 40
_SAME = 0.999
_NOISE = 0.002

Array64 = NDArray[np.float64]
Ask = Callable[[NDArray[np.float32]], tuple[bool, float]]
"""Whether a probe is accepted, and its similarity, which takes the right to scores."""


@dataclass(frozen=True, eq=False, repr=False)
class Prior:
    """What the attacker knows before it asks.

    Parameters
    ----------
    mean : (k,) float64
        Mean of all faces.
    axes : (k, k) float64
        Square root of the faces' second moment, symmetric.
    trend : (3,) float64
        Mean score of a probe e over templates: ``trend @ [1, e·mean, ‖axes e‖²]``.
    kernel : (2,) float64
        Covariance of the scores of e and f over templates: ``kernel @ [c, c²]``, with
        c = (axes e)·(axes f). The first is of ``e·p``, the second of ``‖D e‖²``.
    noise
        Added to the variance of every score: what the two terms leave unexplained. Much less than
        the residual of the fit, which is no noise but what they miss of a smooth function.
    """

    mean: Array64
    axes: Array64
    trend: Array64
    kernel: Array64
    noise: float


def learn_prior(faces: NDArray[np.floating], templates: SubspaceBatch) -> Prior:
    """Learn from faces, (A, k) unit rows, and templates that the attacker lifted from others."""
    points = np.asarray(faces, dtype=np.float64)
    mean = points.mean(axis=0)
    values, vectors = np.linalg.eigh(points.T @ points / len(points))
    axes = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    strangers = points[:OWN_TEMPLATES]
    distances = pairwise_distances(strangers.astype(np.float32), templates, metric=Metric.SPHERICAL)
    scores = np.asarray(similarity(distances), dtype=np.float64)
    inner = strangers @ axes
    features = np.stack([np.ones(len(inner)), strangers @ mean, (inner**2).sum(axis=1)], axis=1)
    trend = np.linalg.lstsq(features, scores.mean(axis=1), rcond=None)[0]
    centred = scores - scores.mean(axis=1, keepdims=True)
    covariance = centred @ centred.T / (scores.shape[1] - 1)
    gram = inner @ inner.T
    terms = np.stack([gram.ravel(), gram.ravel() ** 2], axis=1)
    kernel = np.maximum(np.linalg.lstsq(terms, covariance.ravel(), rcond=None)[0], 0)
    return Prior(mean, axes, trend, kernel, float(_NOISE * np.diagonal(covariance).mean()))


def climb(ask: Ask, prior: Prior, start: NDArray[np.floating], *, most: int, seed: int) -> float:
    """Ask until a probe is accepted: the number of that attempt, infinity where none is.

    All before it failed, so a lockout after so many consecutive failures ends the attack.

    Notes
    -----
    Gaussian-process regression with the prior's kernel, asked where it is highest. It climbs what
    the scores add to the mean over all templates, and not the sum: what every template is near to
    is a wolf, whose score is no higher for it.
    """
    rng = np.random.default_rng(seed)
    linear, square = prior.kernel
    moment = prior.axes @ prior.axes
    place = normalised(np.asarray(start, dtype=np.float64))
    probes: list[Array64] = []
    scores: list[float] = []
    for attempt in range(1, most + 1):
        accepted, seen = ask(np.ascontiguousarray(place, dtype=np.float32))
        if accepted:
            return attempt
        probes.append(place)
        scores.append(seen)
        rows = np.stack(probes)
        turned = rows @ moment
        gram = rows @ turned.T
        trend = prior.trend[0] + prior.trend[1] * rows @ prior.mean
        trend = trend + prior.trend[2] * np.diagonal(gram)
        covariance = linear * gram + square * gram**2
        covariance[np.diag_indices_from(covariance)] += prior.noise
        weights = np.linalg.solve(covariance, np.asarray(scores) - trend)
        place = rows[int(np.argmax(scores))]
        for step in np.geomspace(0.5, 0.02, _ASCENT_STEPS):
            slope = turned.T @ (weights * (linear + 2 * square * (turned @ place)))
            slope -= (slope @ place) * place
            place = normalised(place + step * normalised(slope))
        if np.max(rows @ place) > _SAME:
            aside = prior.axes @ rng.normal(size=len(place))
            place = normalised(place + 0.3 * normalised(aside))
    return np.inf


@attack(breaks=Property.IMPERSONATION, needs=Knowledge(template=False, lifting=True, scores=True))
def hill_climbing(bed: Testbed) -> Iterator[Hits]:
    """Probes are sent and climb by the scores that come back, until one is accepted.

    Success within lockouts, and in all attempts.
    """
    bed = bed.first(bed.effort.climbed)
    most = bed.effort.attempts
    count = min(OWN_TEMPLATES, len(bed.gallery) // 2)
    if count < 2:
        raise AuditError("a climber learns on faces of four people or more")
    own = bed.lift(bed.gallery[-count:], "rehearsal of a climb")
    prior = learn_prior(bed.gallery[:-count], own)
    reached = np.array(
        [
            climb(answers(bed, victim), prior, bed.gallery[0], most=most, seed=bed.seed + victim)
            for victim in range(len(bed.templates))
        ]
    )
    median = float(np.median(reached))
    for limit in sorted({*(lockout for lockout in LOCKOUTS if lockout <= most), most}):
        yield Hits(
            reached <= limit,
            f"{limit} attempts",
            chance=1 - (1 - fmr_of(bed.level)) ** limit,
            details={"limit": limit, "median_attempts": median if np.isfinite(median) else None},
        )


def answers(bed: Testbed, victim: int) -> Ask:
    """Return what the service says of a probe: its decision, and the similarity."""
    template = bed.templates[np.array([victim])]

    def ask(probe: NDArray[np.float32]) -> tuple[bool, float]:
        scores = score(probe[None], template, bed.nobody, bed.points)
        return bool(scores.at(bed.level)[0, 0]), float(scores.similarities[0, 0])

    return ask
