"""Nearest neighbour: the attacker's face that lies nearest to a template (paper §4.2).

Where the victim's own photo is in the gallery, the template tells who it is; where it is not, the
neighbour, or the point of the template nearest to it, is a guess of the hidden descriptor.
"""

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property
from attacks.recovery import recovery_outcome
from attacks.system import System
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.distances import Metric, pairwise_distances
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate


def nearest_entries(
    gallery: NDArray[np.float32],
    templates: SubspaceBatch,
    *,
    count: int = 1,
    metric: Metric = Metric.SPHERICAL,
) -> NDArray[np.int64]:
    """Numbers of the gallery entries (G, k) nearest to every template, shape (T, count)."""
    distances = pairwise_distances(gallery, templates, metric=metric).T
    if count == 1:
        return np.asarray(np.argmin(distances, axis=1)[:, None])
    return np.asarray(np.argsort(distances, axis=1, kind="stable")[:, :count])


def nearest_points(points: NDArray[np.floating], templates: SubspaceBatch) -> NDArray[np.float64]:
    """Return the unit-length point of template i that is nearest to point i, shape (T, n)."""
    bases = templates.bases.astype(np.float64)
    inside = points.astype(np.float64)[:, None, :] @ bases.transpose(0, 2, 1)
    lengths = np.maximum(np.linalg.norm(inside, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    return np.asarray(
        templates.feet + templates.radii[:, None] * ((inside / lengths) @ bases)[:, 0, :]
    )


def nearest_neighbour_attack(system: System) -> list[AttackOutcome]:
    """Attack with another photo of the victim in the gallery, and without."""
    return [_identify(system), _guess(system)]


def _identify(system: System) -> AttackOutcome:
    gallery = np.concatenate([system.attacker, system.victims.fresh])
    truth = np.arange(len(system.attacker), len(gallery))

    def identified(metric: Metric) -> Rate:
        first = nearest_entries(gallery, system.templates, metric=metric)[:, 0]
        return rate(int(np.count_nonzero(first == truth)), len(truth))

    return AttackOutcome(
        attack="nearest-neighbour",
        variant="victim in the gallery",
        breaks=Property.UNLINKABILITY,
        leaked=Leaked.HOLDER_KEYS,
        knowledge=Knowledge.ALGORITHM,
        assumption=(
            "The attacker has the template without its rotation and a gallery with another photo "
            "of the victim; success is the victim at rank 1."
        ),
        scheme=system.scheme,
        measured=identified(Metric.SPHERICAL),
        chance=1 / len(gallery),
        unjudged="whoever can match a template against photos can do this, in any system",
        details={
            "gallery": len(gallery),
            "euclidean": identified(Metric.EUCLIDEAN).to_json(),
        },
    )


def _guess(system: System) -> AttackOutcome:
    gallery = system.attacker
    details: dict[str, Json] = {"gallery": len(gallery)}
    truth = system.victims.enrolled.astype(np.float64)
    for metric in (Metric.EUCLIDEAN, Metric.SPHERICAL):
        first = nearest_entries(gallery, system.templates, metric=metric)[:, 0]
        cosines = np.einsum("ij,ij->i", gallery[first].astype(np.float64), truth)
        details[f"cosine_of_neighbour_to_truth_mean_{metric}"] = float(cosines.mean())
    return recovery_outcome(
        system,
        nearest_points(gallery[first], system.templates),
        attack="nearest-neighbour",
        variant="victim not in the gallery",
        knowledge=Knowledge.ALGORITHM,
        assumption=(
            "The attacker has a gallery of other people's faces, and guesses the unit-length point "
            "of the template that is nearest to the nearest of them; success is a match with a "
            "fresh photo of the victim."
        ),
        details=details,
    )
