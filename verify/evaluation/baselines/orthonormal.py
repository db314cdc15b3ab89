"""Random orthonormal matrices, which both schemes project with."""

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from templates.keys.randomness import Keystream

Matrix = NDArray[np.float32]
"""Weights of a layer, of shape (inputs, outputs): a row of descriptors times it is the output."""
Flips = NDArray[np.float32]
"""One sign, ±1, per descriptor and input of a layer: of shape (R, inputs)."""


def orthonormal(inputs: int, outputs: int, *, stream: Keystream) -> Matrix:
    """Draw a float32 matrix (Haar) with orthonormal columns, or rows where it widens.

    The papers orthonormalise random numbers by Gram–Schmidt; Householder's QR of a Gaussian
    matrix, with the signs of R's diagonal moved into Q, gives the Haar measure without its loss of
    orthogonality.
    """
    narrow, wide = sorted((inputs, outputs))
    drawn = stream.normal((wide, narrow)).astype(np.float32)
    q, r = scipy.linalg.qr(drawn, mode="economic", overwrite_a=True, check_finite=False)
    q *= np.where(np.diagonal(r) < 0, np.float32(-1), np.float32(1))
    return np.ascontiguousarray(q if outputs == narrow else q.T)
