"""Distances in float64 from explicit differences: the specification of the package.

Paper eq. 1 to 9; docs/method.md §3. Whatever float32 would get wrong (near pairs, nearly singular
ones, squares that overflow) is computed here too. A pair costs what it costs: nothing is shared
between pairs, and no small number is the difference of large ones.

Descriptors are of unit length, so with the spherical metric only the points of a subspace at unit
length count. A subspace with foot point p meets the unit sphere in a sphere around p of radius
s = √(1 − ‖p‖²).
"""

from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from templates.distances.metric import LONGEST, Indices, Metric, parts
from templates.errors import InvalidTemplate, LiftingError
from templates.space.subspace import SubspaceBatch, span_basis

_CHUNK_BYTES = 32 << 20
_POINTS = 256

# A direction shared by two subspaces to within this angle is one direction: float32 storage
# turns equal directions by 10⁻⁷. Squared, because eigenvalues of the Gram matrix are compared.
_SHARED_ANGLE2 = 4e-12
# Leaves 10⁻¹⁰ of a float16 basis of 160 rows in R⁵¹², whose E has a norm of 3·10⁻⁴.
_PASSES = 2
# A pair is finished when a step moves v by less than this; what is left of the similarity is of
# the order of its square.
_STILL = 1e-10
_TINY = np.finfo(np.float64).tiny

Doubles = NDArray[np.float64]


class Rows(NamedTuple):
    """Subspaces in float64: feet (N, n) and bases (N, m, n)."""

    feet: Doubles
    bases: Doubles

    @classmethod
    def of(cls, batch: "SubspaceBatch | Rows", index: slice | Indices) -> Self:
        """Take some subspaces of a batch as they are stored."""
        return cls(batch.feet[index].astype(np.float64), batch.bases[index].astype(np.float64))

    @classmethod
    def cleaned(cls, batch: SubspaceBatch) -> Self:
        """Free a batch of the rounding of its float32 storage.

        Raises
        ------
        InvalidTemplate
            The basis is nowhere near orthonormal.
        """
        try:
            bases = span_basis(batch.bases.astype(np.float64))
        except LiftingError:
            raise InvalidTemplate("a template's basis is linearly dependent") from None
        feet = batch.feet.astype(np.float64)
        return cls(feet - _inside(feet[:, None], bases)[:, 0], bases)


def pairwise(probes: Any, templates: SubspaceBatch, *, metric: Metric, steps: int) -> Doubles:
    """Distances of every probe, a point or a subspace, to every template, shape (P, T)."""
    out = np.empty((len(probes), len(templates)))
    right = Rows.cleaned(templates)
    if isinstance(probes, SubspaceBatch):
        left = Rows.cleaned(probes)
        i, j = (side.ravel() for side in np.indices(out.shape))
        out[i, j] = pairs(left, right, i, j, metric=metric, steps=steps)
        return out
    for rows in parts(len(probes), _POINTS):
        points = probes[None, rows].astype(np.float64)
        for columns in _chunks(len(templates), 3 * points.size + right.bases[0].size):
            some = Rows.of(right, columns)
            out[rows, columns] = _POINT_DISTANCES[metric](points, some).T
    return out


def pairs(
    probes: Any,
    templates: SubspaceBatch | Rows,
    i: Indices,
    j: Indices,
    *,
    metric: Metric,
    steps: int,
    as_stored: bool = False,
) -> Doubles:
    """Distances of probes ``i`` to templates ``j``, shape (K,).

    With `as_stored`, points allow for templates that float16 has rounded, at almost twice the work.
    """
    out = np.empty(len(i))
    lifted = not isinstance(probes, np.ndarray)
    rows = templates.bases.shape[1] + (probes.bases.shape[1] if lifted else 0)
    for part in _chunks(len(i), 2 * rows * templates.feet.shape[1]):
        right = Rows.of(templates, j[part])
        if not lifted:
            points = probes[i[part], None].astype(np.float64)
            if metric is Metric.EUCLIDEAN:
                out[part] = _euclidean_points(points, right)[:, 0]
            else:
                out[part] = _spherical_points(points, right, as_stored=as_stored)[:, 0]
        elif metric is Metric.EUCLIDEAN:
            out[part] = _euclidean_subspaces(Rows.of(probes, i[part]), right)
        else:
            out[part] = _spherical_subspaces(Rows.of(probes, i[part]), right, steps)
    return out


def _chunks(count: int, numbers_each: int) -> list[slice]:
    """Split ``count`` items so that ``numbers_each`` float64 numbers of an item stay bounded."""
    return parts(count, max(1, _CHUNK_BYTES // (8 * numbers_each)))


def _inside(rows: Doubles, bases: Doubles) -> Doubles:
    """Parts of rows (…, k, n) inside the spans of bases (N, m, n)."""
    return np.asarray(rows @ bases.transpose(0, 2, 1) @ bases)


# --- points, (N or 1, k, n), to N subspaces, as (N, k) -------------------------------------------


def _euclidean_points(points: Doubles, right: Rows) -> Doubles:
    gaps: Doubles = points - right.feet[:, None]
    for _ in range(2):  # once more, because the stored basis is orthonormal to float32 only
        gaps -= _inside(gaps, right.bases)
    return np.asarray(np.linalg.norm(gaps, axis=2))


def _projected(rows: Doubles, bases: Doubles) -> Doubles:
    """Parts of rows (N, k, n) inside the spans of bases that are orthonormal to float16 only.

    Their Gram matrix is I + E with a small E, so what one pass leaves is E times as large.
    """
    columns = bases.transpose(0, 2, 1)
    wanted = rows @ columns
    coefficients = wanted
    for _ in range(_PASSES):
        coefficients = coefficients + (wanted - coefficients @ bases @ columns)
    return np.asarray(coefficients @ bases)


def _spherical_points(points: Doubles, right: Rows, *, as_stored: bool = False) -> Doubles:
    """Distances; with `as_stored` of N × k points to sets that storage has rounded."""
    units, feet, bases = normalised(points), right.feet, right.bases
    if as_stored:
        # Each by itself: BLAS takes a matrix and one row as they lie, and repacks it for two rows.
        inside = _projected(units, bases)
        feet = feet - _projected(feet[:, None], bases)[:, 0]
        nearest = normalised(inside)
        nearest += ~inside.any(axis=2, keepdims=True) * normalised(bases[:, :1])
    else:
        nearest = _directions(units @ bases.transpose(0, 2, 1)) @ bases
    scales, radii = spheres(feet)
    nearest *= radii[:, None, None]
    nearest += (feet * scales[:, None])[:, None]
    gaps = np.linalg.norm(units - nearest, axis=2)
    # A zero probe has no direction: similarity 0 with everything.
    return np.asarray(np.where(units.any(axis=2), gaps, np.sqrt(2.0)))


_POINT_DISTANCES = {Metric.EUCLIDEAN: _euclidean_points, Metric.SPHERICAL: _spherical_points}


# --- K subspaces to as many others, as (K,) ------------------------------------------------------


def _euclidean_subspaces(left: Rows, right: Rows) -> Doubles:
    """Residual of q − p after least squares on the rows of both bases.

    By the eigenvectors of their Gram matrix without those that only rounding keeps apart (the
    minimum-norm solution). It is 0 only if the residual is, and defined for parallel and for
    intersecting subspaces.
    """
    rows = np.concatenate([left.bases, right.bases], axis=1)
    columns = rows.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(rows @ columns)
    inverse = np.where(values > _SHARED_ANGLE2, 1 / np.maximum(values, _SHARED_ANGLE2), 0)
    gaps = (right.feet - left.feet)[:, :, None]
    for _ in range(2):  # the second pass removes the first one's rounding
        inside = vectors.transpose(0, 2, 1) @ (rows @ gaps)
        gaps = gaps - columns @ (vectors @ (inverse[:, :, None] * inside))
    return np.asarray(np.linalg.norm(gaps[:, :, 0], axis=1))


def _spherical_subspaces(left: Rows, right: Rows, steps: int) -> Doubles:
    """Difference of the closest points that the iteration finds."""
    _, problem = problem_of(left, right)
    _, v = maximise(problem, _starts(problem), steps)
    u = problem.g + _times(problem.b, v)
    x, y = _point_of_sphere(left, u), _point_of_sphere(right, v)
    return np.asarray(np.linalg.norm(x - y, axis=1))


def _point_of_sphere(side: Rows, coefficients: Doubles) -> Doubles:
    scales, radii = spheres(side.feet)
    inside = _times(side.bases.transpose(0, 2, 1), _directions(coefficients))
    return np.asarray(side.feet * scales[:, None] + radii[:, None] * normalised(inside))


# --- the sphere, and the spherical iteration ----------------------------------------------------


def spheres(feet: NDArray[np.floating[Any]]) -> tuple[Doubles, Doubles]:
    """Factors of the foot points (N, n), 1 or 1/‖p‖, and radii of the intersections, (N,).

    A set that misses the sphere (‖p‖ > 1) holds no descriptor. It is replaced by its foot point's
    direction, so that no similarity exceeds 1.
    """
    norms = np.sqrt(np.einsum("ij,ij->i", feet, feet, dtype=np.float64))
    return 1 / np.maximum(norms, 1), np.sqrt(np.maximum(1 - norms**2, 0))


def normalised(rows: Doubles) -> Doubles:
    """Unit rows along the last axis; a zero row stays zero."""
    norms = np.sqrt(np.einsum("...i,...i->...", rows, rows))[..., None]
    return np.asarray(rows / np.maximum(norms, _TINY))


def _directions(coefficients: Doubles) -> Doubles:
    """Unit coefficients; the first axis, which does as well as any other, where all are 0."""
    units = normalised(coefficients)
    units[..., 0] += ~coefficients.any(axis=-1)
    return units


class Problem(NamedTuple):
    """Maximise g·u + h·v + uᵀBv over unit u and v, for K pairs."""

    g: Doubles
    """s D q, shape (K, m_D)."""
    h: Doubles
    """t E p, shape (K, m_E)."""
    b: Doubles
    """s t D Eᵀ, shape (K, m_D, m_E)."""
    transposed: Doubles
    """Bᵀ, contiguous: small products with a transposed view are four times slower."""

    def take(self, index: slice | Indices) -> Self:
        """Return some of the pairs."""
        return type(self)(*(part[index] for part in self))


def problem_of(left: Rows, right: Rows) -> tuple[Doubles, Problem]:
    """Products p·q of K pairs, (K,), and the problems of the rest of the similarity."""
    (scale, s), (their_scale, t) = spheres(left.feet), spheres(right.feet)
    p, q = left.feet * scale[:, None], right.feet * their_scale[:, None]
    b = (s * t)[:, None, None] * (left.bases @ right.bases.transpose(0, 2, 1))
    return np.einsum("ki,ki->k", p, q), Problem(
        s[:, None] * _times(left.bases, q),
        t[:, None] * _times(right.bases, p),
        b,
        np.ascontiguousarray(b.transpose(0, 2, 1)),
    )


def _starts(problem: Problem) -> Doubles:
    """Starts of v, shape (K, 2, m_E): the leading right singular vector of B with both signs.

    The objective has one or two local maxima, on either side of that vector, and its two signs
    lead to both: of 45,000 pairs of lifted faces, random subspaces and wolves one (in R⁸) ended
    more than 10⁻⁴ below random restarts. The vector is a column of a power of BᵀB, as good as the
    exact one, and cheaper.
    """
    power = problem.transposed @ problem.b
    for _ in range(5):
        power /= np.maximum(np.einsum("kii->k", power), _TINY)[:, None, None]
        power = power @ power
    largest = np.argmax(np.einsum("kii->ki", power), axis=1)
    leading = normalised(power[np.arange(len(power)), :, largest])
    return np.stack([leading, -leading], axis=1)


def maximise(problem: Problem, starts: Doubles, steps: int) -> tuple[Doubles, Doubles]:
    """Best value over all starts, shape (K,), and its v, shape (K, m_E).

    One step is u ← normalise(g + B v), v ← normalise(h + Bᵀu), which never lowers the value. It
    converges linearly, slowly where two singular values are close; an Anderson extrapolation of
    depth one through the last two steps mends that. Where the extrapolated point is worse than
    the last one, the plain step is taken instead, so the value rises in every step.
    """
    count = len(starts)
    values, best_v = np.empty(starts.shape[:2]), starts.copy()
    active = np.arange(count)
    v = starts
    value, stepped = _step(problem, v)
    moved = stepped - v
    trial = stepped
    for taken in range(1, steps):
        next_value, next_stepped = _step(problem, trial)
        worse = (next_value < value).any(axis=1)
        if taken > 1 and worse.any():
            again = np.flatnonzero(worse)
            keep = (next_value[again] >= value[again])[:, :, None]
            trial[again] = np.where(keep, trial[again], stepped[again])
            next_value[again], next_stepped[again] = _step(problem.take(again), trial[again])
        next_moved = next_stepped - trial
        turn = next_moved - moved
        slope = np.einsum("ksi,ksi->ks", next_moved, turn)
        slope /= np.maximum(np.einsum("ksi,ksi->ks", turn, turn), _TINY)
        np.clip(slope, -LONGEST, LONGEST, out=slope)
        v, value, moved = trial, next_value, next_moved
        trial = normalised(next_stepped - slope[:, :, None] * (next_stepped - stepped))
        stepped = next_stepped
        if taken % 4 == 0:
            done = (np.einsum("ksi,ksi->ks", moved, moved) < _STILL**2).all(axis=1)
            if done.any():
                values[active[done]], best_v[active[done]] = value[done], v[done]
                left = np.flatnonzero(~done)
                active, problem = active[left], problem.take(left)
                v, value, moved, trial, stepped = (
                    part[left] for part in (v, value, moved, trial, stepped)
                )
                if not left.size:
                    break
    values[active], best_v[active] = value, v
    winner = np.argmax(values, axis=1)
    every = np.arange(count)
    return values[every, winner], best_v[every, winner]


def _step(problem: Problem, v: Doubles) -> tuple[Doubles, Doubles]:
    """Value at v with the best u, shape (K, S), and the next v, shape (K, S, m_E)."""
    u = v @ problem.transposed
    u += problem.g[:, None, :]
    norms = np.sqrt(np.einsum("ksi,ksi->ks", u, u))
    u /= np.maximum(norms, _TINY)[:, :, None]
    norms += np.einsum("ksi,ki->ks", v, problem.h)
    following = u @ problem.b
    following += problem.h[:, None, :]
    return norms, normalised(following)


def _times(matrices: Doubles, rows: Doubles) -> Doubles:
    return np.asarray((matrices @ rows[..., None])[..., 0])
