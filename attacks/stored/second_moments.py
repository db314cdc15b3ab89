"""Second moments: the strongest guess of an embedding, by the attackers of a calibration's verdict.

The attackers differ in the faces that they have, 1,000, 5,000, and all that there are, and in how
they count them: every photo, one photo of each person, or the mean of a person's photos, as people
are enrolled. One without limit is simulated, because nobody has faces without limit.
``attacks.second_order`` has the guess.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from attacks.second_order import Moments, likeliest_embeddings
from templates.space.lifting import plain_strategy
from templates.space.subspace import SubspaceBatch

SPHERE_SHARES = (0.15, 0.3, 0.5, 0.7)
"""Shares of the decoys' moments, beside the sphere's, that templates with random directions are
attacked with. The best counts; on real faces that was 0.3."""


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge(generator=True, faces=True))
def second_moments(bed: Testbed) -> Iterator[Guesses]:
    """The point of a template that is likeliest the face, given that decoys make up the rest."""
    for one in (bed,) if bed.drawn is None else (bed, bed.drawn):
        for share, decoys in decoy_forms(bed):
            for attacker in one.attackers:
                faces = "unlimited" if attacker.faces is None else f"{attacker.faces:,}"
                of_decoys = "" if share == 1 else f", {share:g} of decoys' moments"
                yield Guesses(
                    likeliest_embeddings(one.templates, attacker.moments, decoys),
                    f"{faces} faces, {attacker.counted}{of_decoys}",
                    people=None if one is bed else one.victims,
                    details={
                        "faces": "unlimited, simulated"
                        if attacker.faces is None
                        else attacker.faces,
                        "counted": attacker.counted,
                        "share_of_decoys": share,
                    },
                )


def decoy_forms(bed: Testbed) -> tuple[tuple[float, Moments], ...]:
    """Moments of what surrounds an embedding in a template, with the share that is decoys'."""
    decoys = plain_strategy(bed.strategy).decoys(bed.m)
    if decoys == bed.m:
        return ((1.0, bed.decoys),)
    shares = SPHERE_SHARES if decoys else (0.0,)
    return tuple((share, bed.decoys.with_sphere(share)) for share in shares)


def likeliest(bed: Testbed, templates: SubspaceBatch) -> NDArray[np.float64]:
    """Guess as the attacker with all faces does, (T, k); of people's means where they have several.

    Of templates with random directions by the share that was best on real faces.
    """
    forms = decoy_forms(bed)
    return likeliest_embeddings(
        templates, bed.attackers[-1].moments, forms[min(1, len(forms) - 1)][1]
    )
