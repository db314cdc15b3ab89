"""Unit vectors: the check that every raw embedding passes before anything is computed from it."""

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.errors import InvalidEmbedding

UNIT_TOLERANCE = 1e-3
_LEAST_NORM = 1e-12
FloatT = TypeVar("FloatT", bound=np.floating)


def normalised(rows: NDArray[FloatT]) -> NDArray[FloatT]:
    """Scale vectors along the last axis to norm 1, in their dtype; unchecked, and zeros stay."""
    norms = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.asarray(rows / np.maximum(norms, _LEAST_NORM))


def unit_descriptors(descriptors: ArrayLike) -> NDArray[np.float64]:
    """Check embeddings and normalise them in float64.

    One that is not a unit vector is refused, since distances assume the unit sphere: the zero
    vector is at Euclidean distance ‖p‖ from every template (docs/method.md §4.7).

    Returns float64 (N, n). InvalidEmbedding for another shape, a number that is not finite, or a
    norm that differs from 1 by more than 1e-3.
    """
    rows = np.asarray(descriptors)
    if rows.ndim != 2 or rows.shape[1] < 2 or not np.issubdtype(rows.dtype, np.floating):
        raise InvalidEmbedding(
            f"expected floating-point embeddings of shape (N, n), "
            f"seen {rows.dtype} of shape {rows.shape}"
        )
    rows = rows.astype(np.float64)
    if not np.isfinite(rows).all():
        raise InvalidEmbedding("an embedding holds a number that is not finite")
    # No entry of a unit vector exceeds 1; clipping keeps the squares of a larger one finite, and
    # its norm is still 2 or more.
    norms = np.linalg.norm(np.clip(rows, -2.0, 2.0), axis=1, keepdims=True)
    if (np.abs(norms - 1.0) > UNIT_TOLERANCE).any():
        raise InvalidEmbedding(
            f"an embedding must have norm 1 within {UNIT_TOLERANCE:g}; L2-normalise it"
        )
    return np.asarray(rows / norms)


def unit_rows(embeddings: NDArray[np.generic], *, n: int, most: int) -> NDArray[np.float32]:
    """:func:`unit_descriptors` for what a client sends: at most `most` rows of `n` numbers, or one.

    Returns float32 (k, n), C-contiguous.
    """
    array = np.asarray(embeddings)
    if array.dtype.kind not in "fiu":
        raise InvalidEmbedding("an embedding must be a list of numbers")
    rows = array[None] if array.ndim == 1 else array
    if rows.ndim != 2 or rows.shape[1] != n:
        raise InvalidEmbedding(f"an embedding must have exactly {n} numbers")
    if not 1 <= rows.shape[0] <= most:
        raise InvalidEmbedding(f"1 to {most} embeddings are accepted, not {rows.shape[0]}")
    return np.ascontiguousarray(unit_descriptors(rows.astype(np.float64)), dtype=np.float32)
