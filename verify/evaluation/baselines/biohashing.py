"""BioHashing: the signs of a descriptor's projections on token-seeded orthonormal directions.

A. B. J. Teoh, D. C. L. Ngo, A. Goh, "BioHashing: two factor authentication featuring fingerprint
data and tokenised random number", Pattern Recognition 37 (2004); for faces: A. B. J. Teoh, A. Goh,
D. C. L. Ngo, "Random multispace quantization as an analytic mechanism for BioHashing of biometric
and random identity inputs", IEEE TPAMI 28 (2006).

The token seeds l ≤ n random vectors of n numbers, which are orthonormalised; bit i of the code is
whether the descriptor's product with vector i exceeds a threshold, here 0 as in the papers.
"""

import numpy as np
from numpy.typing import NDArray

from templates.keys.randomness import Keystream
from verify.evaluation.baselines.orthonormal import Flips, Matrix, orthonormal


def weights(n: int, bits: int, *, stream: Keystream) -> tuple[Matrix, ...]:
    """Directions of a token: one matrix of shape (n, bits)."""
    return (orthonormal(n, bits, stream=stream),)


def code(
    descriptors: NDArray[np.float32], layers: tuple[Matrix, ...], flips: tuple[Flips, ...]
) -> NDArray[np.bool_]:
    """Hash (R, n) descriptors under the directions diag(flips) · layers[0]; (R, bits)."""
    (directions,), (signs,) = layers, flips
    projected: NDArray[np.floating] = (descriptors * signs) @ directions
    return projected > 0
