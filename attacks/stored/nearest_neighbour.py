"""Nearest neighbour: the attacker's face that lies nearest to a template (paper §4.2).

Where the victim's own photo is in the gallery, the template tells who it is; where it is not, the
neighbour, or the point of the template nearest to it, is a guess of the hidden descriptor.
"""

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import POOLED, AttackOutcome, Knowledge, Leaked, Property
from attacks.recovery import recovery_outcome
from attacks.stored.known_database import find_decoys
from attacks.stored.recording import decoy_count
from attacks.system import System
from templates.contract.canonical import Json
from templates.decoys import DecoyPool
from templates.distances import Metric, pairwise_distances
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate


def nearest_entries(
    gallery: NDArray[np.float32],
    templates: SubspaceBatch,
    *,
    count: int = 1,
    metric: Metric = Metric.SPHERICAL,
    skip: list[NDArray[np.int64]] | None = None,
) -> NDArray[np.int64]:
    """Numbers of the gallery entries (G, n) nearest to every template, shape (T, count).

    Parameters
    ----------
    skip
        Of every template, entries that are passed over.
    """
    distances = pairwise_distances(gallery, templates, metric=metric).T.copy()
    for row, entries in enumerate(skip or []):
        distances[row, entries] = np.inf
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
    """Victim in the gallery or not, decoys in the gallery or not.

    Nobody owns generated decoys, so with a generator they are in no gallery.
    """
    outcomes = [_identify(system, system.attacker), _guess(system, system.attacker)]
    if system.scheme.decoys == POOLED and isinstance(system.source, DecoyPool):
        gallery = np.concatenate([system.attacker, system.source.entries[0]])
        outcomes += [_identify(system, gallery), _guess(system, gallery)]
    return outcomes


def _variant(system: System, gallery: NDArray[np.float32], victim: str) -> str:
    decoys = "in" if len(gallery) > len(system.attacker) else "not in"
    return f"victim {victim} the gallery, decoys {decoys} it"


def _decoys_in(system: System, gallery: NDArray[np.float32]) -> list[NDArray[np.int64]] | None:
    if len(gallery) == len(system.attacker):
        return None
    return find_decoys(gallery, system.templates, most=decoy_count(system.scheme)).entries


def _identify(system: System, others: NDArray[np.float32]) -> AttackOutcome:
    gallery = np.concatenate([others, system.victims.fresh])
    truth = np.arange(len(others), len(gallery))
    skip = _decoys_in(system, others)

    def identified(metric: Metric, passed: list[NDArray[np.int64]] | None) -> int:
        first = nearest_entries(gallery, system.templates, metric=metric, skip=passed)[:, 0]
        return int(np.count_nonzero(first == truth))

    details: dict[str, Json] = {
        "gallery": len(gallery),
        "euclidean": rate(identified(Metric.EUCLIDEAN, skip), len(truth)).to_json(),
    }
    if skip is not None:
        naive = identified(Metric.SPHERICAL, None)
        details["without_skipping_decoys"] = rate(naive, len(truth)).to_json()
    return AttackOutcome(
        attack="nearest-neighbour",
        variant=_variant(system, others, "in"),
        breaks=Property.UNLINKABILITY,
        leaked=Leaked.HOLDER_KEYS,
        knowledge=Knowledge.ALGORITHM,
        assumption=(
            "The attacker has the template without its rotation and a gallery with another photo "
            "of the victim; success is the victim at rank 1."
        ),
        scheme=system.scheme,
        measured=rate(identified(Metric.SPHERICAL, skip), len(truth)),
        chance=1 / len(gallery),
        unjudged="whoever can match a template against photos can do this, in any system",
        details=details,
    )


def _guess(system: System, gallery: NDArray[np.float32]) -> AttackOutcome:
    skip = _decoys_in(system, gallery)
    details: dict[str, Json] = {"gallery": len(gallery)}
    truth = system.victims.enrolled.astype(np.float64)
    for metric in (Metric.EUCLIDEAN, Metric.SPHERICAL):
        first = nearest_entries(gallery, system.templates, metric=metric, skip=skip)[:, 0]
        cosines = np.einsum("ij,ij->i", gallery[first].astype(np.float64), truth)
        details[f"cosine_of_neighbour_to_truth_mean_{metric}"] = float(cosines.mean())
    guesses = nearest_points(gallery[first], system.templates)
    return recovery_outcome(
        system,
        guesses,
        attack="nearest-neighbour",
        variant=_variant(system, gallery, "not in"),
        knowledge=Knowledge.ALGORITHM,
        assumption=(
            "The attacker has a gallery of other people's faces, passes over those at distance 0, "
            "and guesses the unit-length point of the template that is nearest to the nearest of "
            "the others; success is a match with a fresh photo of the victim."
        ),
        details=details,
    )
