"""MLP-Hash: a token-seeded random perceptron, whose output is binarised.

H. Otroshi Shahreza, V. Krivokuća Hahn, S. Marcel, "MLP-Hash: Protecting Face Templates via Hashing
of Randomized Multi-Layer Perceptron", EUSIPCO 2023 (arXiv 2204.11054).

The token seeds the weights of all layers, pseudo-random and orthonormalised; the descriptor passes
the hidden layers, each followed by a nonlinear function, and the output layer; the output is
binarised at a threshold. Nothing is trained.

Only the abstract of the paper was at hand. What it leaves open is set here, the first as another
reimplementation of the scheme has it for 512 numbers:

- three hidden layers (``HIDDEN_LAYERS``) of twice the descriptor's numbers, 1,024 for 512; for
  larger n they keep 1,024, or n where that is more, as orthonormalising costs the cube;
- max(0, x) after each hidden layer, no bias;
- the output layer is linear, and a bit is whether its number exceeds the mean of all of them;
- the rows of a layer's weights are orthonormal where it narrows. A layer that widens has more
  rows than they have numbers, so its columns are orthonormal instead.

Numbers for it are of this reconstruction from the published description, not of the authors'
program. Every hidden layer brings descriptors nearer to each other (the arc-cosine kernel of Cho &
Saul, NIPS 2009): cosines of 0 and 0.6 are 0.60 and 0.78 after three. So under one token it tells
people apart less well than BioHashing, whatever the matrices.
"""

import itertools

import numpy as np
from numpy.typing import NDArray

from templates.keys.randomness import Keystream
from verify.evaluation.baselines.orthonormal import Flips, Matrix, orthonormal

HIDDEN_LAYERS = 3
_WIDTH = 1024


def hidden_width(n: int) -> int:
    """Units of a hidden layer for descriptors of n numbers."""
    return max(n, min(2 * n, _WIDTH))


def weights(n: int, bits: int, *, stream: Keystream) -> tuple[Matrix, ...]:
    """Weights of all layers of a token's perceptron, from the input to the output."""
    widths = [n, *[hidden_width(n)] * HIDDEN_LAYERS, bits]
    return tuple(
        orthonormal(inputs, outputs, stream=stream)
        for inputs, outputs in itertools.pairwise(widths)
    )


def code(
    descriptors: NDArray[np.float32], layers: tuple[Matrix, ...], flips: tuple[Flips, ...]
) -> NDArray[np.bool_]:
    """Hash (R, n) descriptors by the perceptron of weights diag(flips) · layers; (R, bits)."""
    values: NDArray[np.floating] = descriptors
    for layer, signs in zip(layers[:-1], flips[:-1], strict=True):
        values = (values * signs) @ layer
        np.maximum(values, 0, out=values)
    output: NDArray[np.floating] = (values * flips[-1]) @ layers[-1]
    above: NDArray[np.bool_] = output > output.mean(axis=1, keepdims=True)
    return above
