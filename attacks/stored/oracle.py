"""The paper's oracle: it tells which of the K faces nearest to a template is nearest to the truth.

No attacker has it. It bounds from above what a search among K neighbours could find (supplement,
"Oracle Attack").
"""

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import AttackOutcome, Knowledge, Leaked, Property
from attacks.recovery import fmr_of, score_guesses
from attacks.stored.nearest_neighbour import nearest_entries, nearest_points
from attacks.system import System
from templates.contract.canonical import Json

NEIGHBOURS = (1, 2, 5, 10, 20, 50, 100)


def best_of(
    gallery: NDArray[np.float32], entries: NDArray[np.int64], truth: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the row of ``gallery[entries[i]]`` that is nearest to truth i, shape (T, n).

    Parameters
    ----------
    gallery : (G, n)
        Unit rows.
    entries : (T, K)
    truth : (T, n)
        Unit rows.
    """
    cosines = np.einsum("tkn,tn->tk", gallery[entries], truth)
    best = np.argmax(cosines, axis=1)
    return np.asarray(gallery[entries[np.arange(len(entries)), best]])


def oracle_attack(
    system: System, *, neighbours: tuple[int, ...] = NEIGHBOURS
) -> list[AttackOutcome]:
    """Curve over K, for the neighbour itself and for the nearest unit-length point to it.

    The outcome of either is that of the largest K.
    """
    gallery, truth = system.attacker, system.victims.enrolled
    counts = sorted({min(count, len(gallery)) for count in neighbours})
    entries = nearest_entries(gallery, system.templates, count=counts[-1])
    outcomes = []
    for projected in (False, True):
        curve: list[Json] = []
        for count in counts:
            chosen = best_of(gallery, entries[:, :count], truth)
            guesses = nearest_points(chosen, system.templates) if projected else chosen
            recovery = score_guesses(system, guesses)
            distances = np.sqrt(np.maximum(2 - 2 * recovery.to_truth, 0))
            curve.append(
                {
                    "neighbours": count,
                    "distance_to_truth_mean": float(distances.mean()),
                    "cosine_to_truth_mean": float(recovery.to_truth.mean()),
                    "matched": recovery.matched[system.level.name].to_json(),
                }
            )
        outcomes.append(
            AttackOutcome(
                attack="oracle",
                variant="projected" if projected else "neighbour",
                breaks=Property.IRREVERSIBILITY,
                leaked=Leaked.HOLDER_KEYS,
                knowledge=Knowledge.ALGORITHM,
                assumption=(
                    f"An oracle, which no attacker has, names the best of the {counts[-1]} "
                    "gallery faces nearest to the template; success is a match of "
                    + (
                        "the template's unit-length point nearest to it"
                        if projected
                        else "that face"
                    )
                    + " with a fresh photo of the victim."
                ),
                scheme=system.scheme,
                level=system.level.name,
                measured=recovery.matched[system.level.name],
                chance=fmr_of(system.level),
                unjudged="no attacker has an oracle",
                details={**recovery.details(), "curve": curve},
            )
        )
    return outcomes
