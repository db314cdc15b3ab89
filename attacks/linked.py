"""Templates of two tenants, or two of one, that are linked one by one; success is D_sys."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Attack, LinkScores
from attacks.bed import Testbed
from attacks.outcomes import CONTROL, AttackOutcome, Leaked, unproven
from attacks.rotations import KEPT, holder_rotations_of, rotations_of, turned
from attacks.unlinkability import unlinkability
from templates.space.subspace import SubspaceBatch

ONE_SET = "one set for both"
LINKED = 100
"""Victims whose templates are linked across tenants: every two of them are compared."""
LIFTINGS = 2
"""Times that they are lifted, with other decoys and other keys, which makes histograms finer."""


def linked(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Link two templates of each victim.

    One tenant has enrolled each victim from what is enrolled, the other, or the same one once more,
    from the fresh photo. All pairs of two victims are impostor pairs. The rows are judged where the
    attack links one set in two rotations, a control that is the last row.
    """
    scores: dict[str, list[NDArray[np.float64]]] = {}
    for number in range(LIFTINGS):
        for setting, sides in _sides(bed.first(LINKED), number).items():
            (made,) = attack.run(replace(bed, batches=sides))
            if not isinstance(made, LinkScores):
                raise TypeError(f"{attack.name} must yield scores of two templates")
            scores.setdefault(setting, []).append(made.values)
    rows = {}
    for setting, values in scores.items():
        measured = unlinkability(np.stack(values), seed=bed.seed)
        rows[setting] = attack.row(
            bed,
            variant=setting,
            leaked=Leaked.MASTER_KEY,
            measured=measured.d_sys,
            chance=measured.null_mean,
            unjudged=CONTROL if setting == ONE_SET else None,
            details={
                "null_95_percent": measured.null_95,
                "identified_at_rank_1": measured.first_rank,
                "liftings": LIFTINGS,
            },
        )
    proven = unproven(rows[ONE_SET], "one set in two rotations")
    return [row if name == ONE_SET else replace(row, unjudged=proven) for name, row in rows.items()]


def _sides(bed: Testbed, number: int) -> dict[str, tuple[SubspaceBatch, SubspaceBatch]]:
    """Return both templates of every person as each setting has them, in one lifting."""
    first = bed.lift(bed.victims.enrolled, f"linkage, first tenant {number}")
    second = bed.lift(bed.victims.fresh, f"linkage, second tenant {number}")
    count = len(first)
    left = rotations_of(bed, f"first {number}", "template", count)
    right = rotations_of(bed, f"second {number}", "template", count)
    another = rotations_of(bed, f"first {number}", "another template", count)
    hidden = turned(first, left)
    return {
        "secret rotations": (hidden, turned(second, right)),
        "one tenant": (hidden, turned(second, another)),
        KEPT: (
            turned(first, holder_rotations_of(bed, f"first {number}", count)),
            turned(second, holder_rotations_of(bed, f"second {number}", count)),
        ),
        ONE_SET: (hidden, turned(first, right)),
    }
