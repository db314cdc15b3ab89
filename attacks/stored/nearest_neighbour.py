"""Nearest neighbour: the attacker's face that lies nearest to a template (paper §4.2).

Where the victim's own photo is in the gallery, the template tells who it is; where it is not, the
neighbour, or the point of the template nearest to it, is a guess of the hidden embedding. The
paper's oracle tells which of the K nearest faces is nearest to the truth: no attacker has it, and
it bounds from above what a search among K neighbours could find (supplement, "Oracle Attack").
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from templates.contract.canonical import Json
from templates.distances import Metric, pairwise_distances
from templates.space.subspace import SubspaceBatch
from verify.metrics import rate

NEIGHBOURS = (1, 2, 5, 10, 20, 50, 100)
_ASKED = 150
"""Victims of the oracle, whose curve needs no more."""


def nearest_entries(
    gallery: NDArray[np.float32],
    templates: SubspaceBatch,
    *,
    count: int = 1,
    metric: Metric = Metric.SPHERICAL,
) -> NDArray[np.int64]:
    """Numbers of the gallery entries (G, k) nearest to every template, shape (T, count)."""
    distances = pairwise_distances(gallery, templates, metric=metric).T
    return np.asarray(np.argsort(distances, axis=1, kind="stable")[:, :count])


def nearest_points(points: NDArray[np.floating], templates: SubspaceBatch) -> NDArray[np.float64]:
    """Return the unit-length point of template i that is nearest to point i, shape (T, k)."""
    bases = templates.bases.astype(np.float64)
    inside = points.astype(np.float64)[:, None, :] @ bases.transpose(0, 2, 1)
    lengths = np.maximum(np.linalg.norm(inside, axis=2, keepdims=True), np.finfo(np.float64).tiny)
    return np.asarray(
        templates.feet + templates.radii[:, None] * ((inside / lengths) @ bases)[:, 0, :]
    )


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(generator=True, faces=True))
def nearest_neighbour(bed: Testbed) -> Iterator[Guesses]:
    """The point of unit length of a template that is nearest to the nearest of other faces."""
    first = nearest_entries(bed.gallery, bed.templates)[:, 0]
    # With another photo of the victim in the gallery: confirmation, which every template allows.
    gallery = np.concatenate([bed.gallery, bed.victims.fresh])
    own = nearest_entries(gallery, bed.templates)[:, 0] == len(bed.gallery) + np.arange(
        len(bed.victims)
    )
    yield Guesses(
        nearest_points(bed.gallery[first], bed.templates),
        details={
            "gallery": len(bed.gallery),
            "victims_recognised_in_a_gallery": rate(int(np.count_nonzero(own)), len(own)).to_json(),
        },
    )


def best_of(
    gallery: NDArray[np.float32], entries: NDArray[np.int64], truth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the row of ``gallery[entries[i]]`` that is nearest to truth i; unit rows (T, k)."""
    cosines = np.einsum("tkn,tn->tk", gallery[entries], truth)
    return np.asarray(gallery[entries[np.arange(len(entries)), np.argmax(cosines, axis=1)]])


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(generator=True, faces=True))
def oracle(bed: Testbed) -> Iterator[Guesses]:
    """The best of the faces nearest to a template, or the template's point nearest to that one."""
    some = bed.first(_ASKED)
    gallery, truth = some.gallery, some.victims.enrolled
    counts = sorted({min(count, len(gallery)) for count in NEIGHBOURS})
    entries = nearest_entries(gallery, some.templates, count=counts[-1])
    for variant in ("neighbour", "projected"):
        curve: list[Json] = []
        guesses: NDArray[np.floating] = truth
        for count in counts:
            guesses = best_of(gallery, entries[:, :count], truth)
            if variant == "projected":
                guesses = nearest_points(guesses, some.templates)
            cosines = np.einsum("ij,ij->i", guesses, truth, dtype=np.float64)
            distance = float(np.sqrt(np.maximum(2 - 2 * cosines, 0)).mean())
            curve.append({"neighbours": count, "distance_to_truth_mean": distance})
        yield Guesses(
            guesses,
            variant,
            people=some.victims,
            details={"curve": curve},
            unjudged="no attacker has an oracle",
        )
