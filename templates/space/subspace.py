"""The private template: an affine subspace in a form that shows nothing but the set.

A template stores the foot point (the point of the set nearest the coordinate origin) and an
orthonormal basis. Nothing beyond the set 𝒟 can be read from it (docs/method.md §2.2): the foot
point is a function of 𝒟, and the basis a uniformly random one of span(D), so neither depends on the
descriptor that was lifted nor on the decoys one by one.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.errors import InvalidTemplate, LiftingError
from templates.keys.randomness import Keystream

FLOAT32_TOLERANCE = 1e-5
# Directions closer than this to the span of the others, relative to their own length, are noise
# of float32 inputs rather than directions.
_LEAST_PIVOT = 1e-5
_TILE_BYTES = 16 << 20

Turn = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""An orthogonal map of rows, shape (k, n)."""


def _stored(array: ArrayLike, ndim: int, name: str) -> NDArray[np.float32]:
    """Return a read-only, C-contiguous float32 view or copy."""
    stored = np.ascontiguousarray(array, dtype=np.float32)
    if stored.ndim != ndim:
        raise InvalidTemplate(f"the {name} must have {ndim} axes, not {stored.ndim}")
    view = stored.view()
    view.flags.writeable = False
    return view


def is_finite(numbers: NDArray[np.floating]) -> bool:
    """Whether no number is infinite or NaN."""
    # Both are NaN if any number is, and need no temporary of the numbers' size.
    with np.errstate(invalid="ignore"):
        ends = numbers.max(initial=0), numbers.min(initial=0)
    return bool(np.isfinite(ends).all())


def span_basis(directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormal bases (N, m, n) of the spans of a stack of directions, both float64.

    By Cholesky factorisation of the Gram matrix, twice (CholeskyQR2, Yamamoto et al. 2015): as
    accurate as Householder's up to condition number 10⁷, and eight times as fast in batches. A
    LiftingError where a direction is zero or lies in the span of the others.
    """
    lengths = np.linalg.norm(directions, axis=2, keepdims=True)
    if not lengths.all():
        raise LiftingError("a direction has length zero: the decoy equals the embedding")
    rows = directions / lengths
    for _ in range(2):
        try:
            factor = np.linalg.cholesky(rows @ rows.transpose(0, 2, 1))
        except np.linalg.LinAlgError:
            factor = np.zeros((1, 1, 1))
        if np.diagonal(factor, axis1=1, axis2=2).min() < _LEAST_PIVOT:
            raise LiftingError("the directions of a subspace are linearly dependent: draw others")
        rows = np.linalg.inv(factor) @ rows
    return np.asarray(rows)


def _gram_schmidt(square: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormalise the rows in order; unique, because every row keeps its direction's sign."""
    q, r = np.linalg.qr(square.transpose(0, 2, 1))
    signs = np.where(np.diagonal(r, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return np.ascontiguousarray((q * signs[:, None, :]).transpose(0, 2, 1))


@dataclass(frozen=True, eq=False, repr=False)
class SubspaceBatch:
    """N private templates 𝒟 = foot + span(basis) of one dimension; one template is a batch of one.

    Parameters
    ----------
    feet : ndarray of float32, shape (N, n)
        Foot points, each orthogonal to its basis; (n,) for one template.
    bases : ndarray of float32, shape (N, m, n)
        Orthonormal rows, 1 ≤ m < n; (m, n) for one template.

    The constructor checks shapes only; :meth:`validate` checks the numbers.
    """

    feet: NDArray[np.float32]
    bases: NDArray[np.float32]

    def __post_init__(self) -> None:
        feet, bases = np.asarray(self.feet), np.asarray(self.bases)
        if feet.ndim == 1:
            feet, bases = feet[None], bases[None]
        object.__setattr__(self, "feet", _stored(feet, 2, "feet"))
        object.__setattr__(self, "bases", _stored(bases, 3, "bases"))
        if self.feet.shape != (self.bases.shape[0], self.bases.shape[2]):
            raise InvalidTemplate(
                f"feet of shape {self.feet.shape} do not fit bases of shape {self.bases.shape}"
            )
        if not 1 <= self.m < self.n:
            raise InvalidTemplate(f"expected 1 <= m < n, seen m = {self.m}, n = {self.n}")

    @property
    def foot(self) -> NDArray[np.float32]:
        """Foot point of the one template, shape (n,)."""
        (foot,) = self.feet
        return np.asarray(foot)

    @property
    def basis(self) -> NDArray[np.float32]:
        """Basis of the one template, shape (m, n)."""
        (basis,) = self.bases
        return np.asarray(basis)

    @property
    def foot_norm(self) -> float:
        """‖p‖ of the one template: its distance from the coordinate origin."""
        (norm,) = self.foot_norms
        return float(norm)

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points of the one set that are nearest to ``points``, (k, n) or (n,), in float64."""
        basis = self.basis.astype(np.float64)
        offset = np.asarray(points, dtype=np.float64) - self.foot
        return np.asarray(self.foot + (offset @ basis.T) @ basis)

    def contains(self, points: ArrayLike, tol: float = 1e-5) -> NDArray[np.bool_]:
        """Which of ``points``, shape (k, n), are at most ``tol`` away from the one set."""
        gap = np.asarray(points, dtype=np.float64) - self.project(points)
        return np.asarray(np.linalg.norm(gap, axis=-1) <= tol)

    def validate(self, tol: float = FLOAT32_TOLERANCE) -> None:
        """Check that the numbers are those of templates; InvalidTemplate names what is wrong.

        All are finite, bases orthonormal and foot points orthogonal to them within ``tol``, and no
        foot point lies outside the unit ball, where no set through a unit embedding has it.
        """
        if not self.is_finite:
            raise InvalidTemplate("a template holds a number that is not finite")
        bases, feet = self.bases.astype(np.float64), self.feet.astype(np.float64)
        if np.abs(bases @ bases.transpose(0, 2, 1) - np.eye(self.m)).max(initial=0) > tol:
            raise InvalidTemplate(f"the basis is not orthonormal within {tol:g}")
        if np.abs(bases @ feet[:, :, None]).max(initial=0) > tol:
            raise InvalidTemplate(f"the foot point is not orthogonal to the basis within {tol:g}")
        if self.foot_norms.max(initial=0) > 1 + tol:
            raise InvalidTemplate("the foot point lies outside the unit ball")

    @cached_property
    def is_finite(self) -> bool:
        """Whether no number is infinite or NaN; looked at once, as a batch does not change."""
        return is_finite(self.feet) and is_finite(self.bases)

    @classmethod
    def through(cls, points: ArrayLike, directions: ArrayLike, *, stream: Keystream) -> Self:
        """Return the templates of ``points[i] + span(directions[i])``.

        Parameters
        ----------
        points : array_like, shape (N, n), or (n,) for one
            Any point of each set, an embedding for instance.
        directions : array_like, shape (N, m, n), or (m, n) for one
            Any basis of each direction space.
        stream : Keystream
            Source of the basis; nothing else of the template is random.

        Raises
        ------
        LiftingError
            Shapes that do not fit, a number that is not finite, or dependent directions.

        Notes
        -----
        The basis is O · GS(Π G): G is one Gaussian (m, n) frame for the call, Π the orthogonal
        projection on the direction space, GS the Gram–Schmidt process and O a Haar-distributed
        orthogonal matrix of its own for every row. All three depend on the set and on the stream
        only, so equal sets give equal templates under equal streams, whatever point and
        directions described them; and the basis is Haar-distributed in the direction space,
        independently of everything else. Work is done in float64, a tile of rows at a time.
        """
        start = np.asarray(points)
        spread = np.asarray(directions)
        if start.ndim == 1:
            start, spread = start[None], spread[None]
        count, m, n = spread.shape if spread.ndim == 3 else (0, 0, 0)
        if start.shape != (count, n) or not 1 <= m < n:
            raise LiftingError(
                f"points of shape {start.shape} and directions of shape {spread.shape} do not "
                f"fit: expected (N, n) and (N, m, n) with 1 <= m < n"
            )
        frame = stream.normal((m, n))
        feet = np.empty((count, n), dtype=np.float32)
        bases = np.empty((count, m, n), dtype=np.float32)
        step = max(1, _TILE_BYTES // (8 * m * n))
        for first in range(0, count, step):
            tile = slice(first, min(first + step, count))
            point = start[tile].astype(np.float64)
            direction = spread[tile].astype(np.float64)
            if not (np.isfinite(point).all() and np.isfinite(direction).all()):
                raise LiftingError("a point or a direction holds a number that is not finite")
            span = span_basis(direction)
            for _ in range(2):  # once more removes what rounding left of the span
                point -= ((point[:, None, :] @ span.transpose(0, 2, 1)) @ span)[:, 0, :]
            feet[tile] = point
            turn = _gram_schmidt(stream.normal((len(span), m, m)))
            canonical = _gram_schmidt(frame @ span.transpose(0, 2, 1))
            bases[tile] = (turn @ canonical) @ span
        return cls(feet, bases)

    @classmethod
    def of(cls, batches: Sequence[Self]) -> Self:
        """Join batches of one shape."""
        if not batches:
            raise InvalidTemplate("an empty list has no dimension: give at least one template")
        if len({(batch.m, batch.n) for batch in batches}) > 1:
            raise InvalidTemplate("templates of different dimensions do not fit in one batch")
        return cls(
            np.concatenate([batch.feet for batch in batches]),
            np.concatenate([batch.bases for batch in batches]),
        )

    def __repr__(self) -> str:
        return f"SubspaceBatch({len(self)} of n={self.n}, m={self.m})"

    def __len__(self) -> int:
        return int(self.feet.shape[0])

    def __getitem__(self, index: int | slice | NDArray[np.integer] | NDArray[np.bool_]) -> Self:
        rows = [index] if isinstance(index, (int, np.integer)) else index
        return type(self)(self.feet[rows], self.bases[rows])

    def __iter__(self) -> Iterator[Self]:
        return (self[index] for index in range(len(self)))

    @property
    def n(self) -> int:
        """Descriptor dimension."""
        return int(self.bases.shape[2])

    @property
    def m(self) -> int:
        """Subspace dimension."""
        return int(self.bases.shape[1])

    @property
    def foot_norms(self) -> NDArray[np.float64]:
        """‖p‖ of every template, shape (N,)."""
        squares = np.einsum("ij,ij->i", self.feet, self.feet, dtype=np.float64)
        return np.asarray(np.sqrt(squares))

    @property
    def radii(self) -> NDArray[np.float64]:
        """Radii of the intersections with the unit sphere, shape (N,); 0 where there is none."""
        return np.sqrt(np.maximum(0.0, 1.0 - self.foot_norms**2))

    def turned_by(self, turn: Turn) -> Self:
        """Return the images of the sets under an orthogonal map of rows, shape (k, n).

        Computed in float64, so that a map and its inverse undo each other to float32 rounding.
        """
        bases = np.empty_like(self.bases)
        step = max(1, _TILE_BYTES // (8 * self.m * self.n))
        for first in range(0, len(self), step):
            tile = self.bases[first : first + step].astype(np.float64)
            bases[first : first + step] = turn(tile.reshape(-1, self.n)).reshape(tile.shape)
        return type(self)(turn(self.feet.astype(np.float64)).astype(np.float32), bases)
