"""What an attacker infers who has the decoy generator: the point that is least like a decoy.

Clients lift on their own, so that everybody can draw decoys as they do. Along axes in which the
draws vary less than faces do, only the descriptor has anything to contribute to a template
(``attacks.likelihood``). The guess is a descriptor of a person more or less, and its attributes are
read as those of raw descriptors are.
"""

import numpy as np
from numpy.typing import NDArray

from attacks.likelihood import likeliest_points, precision
from templates.decoys.source import DecoySource
from templates.keys.randomness import Keystream
from templates.space.subspace import SubspaceBatch

Array32 = NDArray[np.float32]
Form = NDArray[np.float64]

DRAWS = 4000
_FACES_PER_AXIS = 2


def decoy_precision(source: DecoySource, *, seed: int) -> Form:
    """Inverse covariance (n, n) of so many decoys that the attacker draws, 2 n at the least."""
    with Keystream.seeded("attributes", seed, "decoys that the attacker draws") as stream:
        drawn = source.draw(max(DRAWS, _FACES_PER_AXIS * source.n), 1, stream=stream)[:, 0, :]
    return precision(drawn)


def contrast(against: Form, faces: Array32) -> Form:
    """Form (n, n) that is large at a face and small at a decoy.

    Parameters
    ----------
    against : (n, n) float64
        From `decoy_precision`.
    faces : (F, n) float32
        The attacker's, none of which is in a template that the form is used on. Fewer than 2 n have
        no covariance worth inverting, and the decoys decide alone.
    """
    if len(faces) < _FACES_PER_AXIS * faces.shape[1]:
        return against
    return np.asarray(against - precision(faces))


def guesses(templates: SubspaceBatch, form: Form) -> Array32:
    """Guess each template's descriptor; unit rows, (P, n) float32."""
    return np.ascontiguousarray(likeliest_points(templates, form), dtype=np.float32)
