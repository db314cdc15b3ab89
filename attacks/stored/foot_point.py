"""The foot point: for a unit embedding d, cos(d, p) = ‖p‖ exactly (docs/method.md §4.1)."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Guesses, attack
from attacks.bed import Testbed
from attacks.outcomes import Knowledge, Property
from templates.space.embedding import normalised
from templates.space.subspace import SubspaceBatch


def foot_points(templates: SubspaceBatch) -> NDArray[np.float64]:
    """Return p / ‖p‖ of every template, shape (T, k)."""
    return normalised(templates.feet.astype(np.float64))


@attack(breaks=Property.IRREVERSIBILITY, needs=Knowledge())
def foot_point(bed: Testbed) -> Iterator[Guesses]:
    """The direction of the point of a template that is nearest to the coordinate origin."""
    yield Guesses(
        foot_points(bed.templates),
        details={"foot_norm_mean": float(bed.templates.foot_norms.mean())},
    )
