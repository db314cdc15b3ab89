"""The check that every raw embedding passes before anything is computed from it."""

import numpy as np
from numpy.typing import NDArray

from templates.errors import InvalidEmbedding

NORM_TOLERANCE = 1e-3


def unit_rows(embeddings: NDArray[np.generic], *, n: int, most: int) -> NDArray[np.float32]:
    """Validate raw embeddings and return them normalised exactly.

    A probe that is not a unit vector is refused, since distances assume the unit sphere: the zero
    vector is at Euclidean distance ‖p‖ from every template (docs/method.md §4.7).

    Parameters
    ----------
    embeddings : (n,) or (k, n) array of numbers
    n
        The contract's descriptor dimension.
    most
        Largest k.

    Returns
    -------
    (k, n) float32, C-contiguous

    Raises
    ------
    InvalidEmbedding
        Wrong shape, not finite, or a norm further than 1e-3 from 1.
    """
    array = np.asarray(embeddings)
    if array.dtype.kind not in "fiu":
        raise InvalidEmbedding("an embedding must be a list of numbers")
    rows = array[None] if array.ndim == 1 else array
    if rows.ndim != 2 or rows.shape[1] != n:
        raise InvalidEmbedding(f"an embedding must have exactly {n} numbers")
    if not 1 <= rows.shape[0] <= most:
        raise InvalidEmbedding(f"1 to {most} embeddings are accepted, not {rows.shape[0]}")
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InvalidEmbedding("an embedding holds a number that is not finite")
    # The largest entry of a unit vector is below 1; testing it first keeps the squares finite.
    norms = np.linalg.norm(np.clip(rows, -2.0, 2.0), axis=1, keepdims=True)
    if np.abs(norms - 1.0).max() > NORM_TOLERANCE or np.abs(rows).max() > 2.0:
        raise InvalidEmbedding(
            f"an embedding must have norm 1 within {NORM_TOLERANCE:g}; L2-normalise it"
        )
    return np.ascontiguousarray(rows / norms, dtype=np.float32)
