"""Distances in float64 from explicit differences: the specification of the package.

Paper eq. 1 to 9; docs/method.md §3. Whatever float32 would get wrong (near pairs, nearly singular
ones, squares that overflow) is computed here too. A pair costs what it costs: nothing is shared
between pairs, and no small number is the difference of large ones.

Descriptors are of unit length, so with the spherical metric only the points of a subspace at unit
length count. A subspace with foot point p meets the unit sphere in a sphere around p of radius
s = √(1 − ‖p‖²).
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from templates.distances.metric import LONGEST, NEAR, STILL, Indices, Metric, Probes, Tile, parts
from templates.space.subspace import SubspaceBatch

_CHUNK_BYTES = 4 << 20
_SIDE = 256

# A direction shared by two subspaces to within this angle is one direction: float32 storage
# turns equal directions by 10⁻⁷. Squared, because eigenvalues of the Gram matrix are compared.
_SHARED_ANGLE2 = 4e-12
# Leaves 10⁻¹⁰ of a float16 basis of 160 rows in R⁵¹², whose E has a norm of 3·10⁻⁴.
_PASSES = 2
# A pair is finished when a step moves v by less than this; what is left of the similarity is of
# the order of its square.
_STILL = 1e-10
# Squared distances below this are made from differences: a square loses half of the digits.
_NEAR2 = 0.25
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


def tiles(
    probes: Probes,
    templates: SubspaceBatch,
    *,
    metric: Metric,
    steps: int,
    dtype: DTypeLike = np.float64,
) -> Iterator[Tile]:
    """Yield rows, columns and distances (R, C) of all parts of the matrix of every pair.

    ``dtype`` is that of the inner products of subspaces on the sphere: float32 leaves an error of
    10⁻⁶ in a similarity.
    """
    if isinstance(probes, SubspaceBatch) and metric is Metric.SPHERICAL:
        most = max(1, _CHUNK_BYTES // (8 * probes.m * templates.m))
        height = min(_SIDE, len(probes), max(1, math.isqrt(most)))
        for columns in parts(len(templates), max(1, min(_SIDE, most // max(1, height)))):
            for rows in parts(len(probes), height):
                sides = probes[rows], templates[columns]
                yield rows, columns, _spherical_tile(*sides, steps, dtype)
        return
    for columns in parts(len(templates), _SIDE):
        some = Rows.of(templates, columns)
        for rows in parts(len(probes), _SIDE):
            group = probes[rows]
            if isinstance(group, SubspaceBatch):
                shape = len(group), len(some.feet)
                i, j = (side.ravel() for side in np.indices(shape))
                of_pairs = pairs(group, some, i, j, metric=metric, steps=steps)
                yield rows, columns, of_pairs.reshape(shape)
                continue
            out = np.empty((len(group), len(some.feet)))
            points = group[None].astype(np.float64)
            for part in _chunks(len(some.feet), 3 * points.size + some.bases[0].size):
                out[:, part] = _POINT_DISTANCES[metric](points, Rows.of(some, part)).T
            yield rows, columns, out


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
    chunks = _chunks(len(i), 2 * rows * templates.feet.shape[1])
    if lifted and metric is Metric.SPHERICAL:
        return _spherical_subspaces(probes, templates, i, j, steps, chunks)
    for part in chunks:
        right = Rows.of(templates, j[part])
        if lifted:
            out[part] = _euclidean_subspaces(Rows.of(probes, i[part]), right)
            continue
        points = probes[i[part], None].astype(np.float64)
        if metric is Metric.EUCLIDEAN:
            out[part] = _euclidean_points(points, right)[:, 0]
        else:
            out[part] = _spherical_points(points, right, as_stored=as_stored)[:, 0]
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


def _spherical_subspaces(
    probes: Any, templates: Any, i: Indices, j: Indices, steps: int, chunks: list[slice]
) -> Doubles:
    """Distances from the similarity, and of near pairs from the closest points themselves."""
    if probes.bases.shape[1] < templates.bases.shape[1]:  # the smaller one is iterated over
        probes, templates, i, j = templates, probes, j, i
    made = [_problem_of(Rows.of(probes, i[part]), Rows.of(templates, j[part])) for part in chunks]
    if not made:
        return np.empty(0)
    dots = np.concatenate([of_pairs for of_pairs, _ in made])
    problems = Problem(*map(np.concatenate, zip(*(of for _, of in made), strict=True)))
    v, gains = maximise(problems, starts_of(problems.gram), steps)
    squared = 2 - 2 * (dots + gains)
    near = np.flatnonzero(squared < _NEAR2)
    for part in parts(len(near), max(1, chunks[0].stop)):
        some = near[part]
        right = Rows.of(templates, j[some])
        scales, radii = spheres(right.feet)
        inside = _times(right.bases.transpose(0, 2, 1), v[some])
        ends = right.feet * scales[:, None] + radii[:, None] * inside
        squared[some] = _spherical_points(ends[:, None], Rows.of(probes, i[some]))[:, 0] ** 2
    return np.sqrt(squared)


def _spherical_tile(
    probes: SubspaceBatch, templates: SubspaceBatch, steps: int, dtype: DTypeLike
) -> Doubles:
    """Distances (R, C) of every probe to every template, from one product of their rows.

    Pairs so near that their squares lose digits of ``dtype`` are computed by :func:`pairs`.
    """
    if probes.m < templates.m:  # the smaller one is iterated over
        return _spherical_tile(templates, probes, steps, dtype).T
    shape, n = (len(probes), len(templates)), probes.n
    (scale, s), (their_scale, t) = spheres(probes.feet), spheres(templates.feet)
    p, q = probes.feet.astype(np.float64), templates.feet.astype(np.float64)
    p, q = p * scale[:, None], q * their_scale[:, None]
    left = probes.bases.reshape(-1, n).astype(dtype, copy=False)
    right = templates.bases.reshape(-1, n)
    # The rows of the larger subspaces are read once.
    products = (left @ np.concatenate([right.astype(dtype, copy=False), q.astype(dtype)]).T).astype(
        np.float64
    )
    products = products.reshape(shape[0], probes.m, -1).transpose(0, 2, 1)
    b = products[:, : len(right)].reshape(*shape, templates.m, probes.m).swapaxes(2, 3)
    g = products[:, len(right) :]
    h = (p @ right.T.astype(np.float64)).reshape(*shape, templates.m)
    problem = _problem(
        (np.multiply.outer(s, t)[..., None, None] * b).reshape(-1, probes.m, templates.m),
        (s[:, None, None] * g).reshape(-1, probes.m),
        (t[:, None] * h).reshape(-1, templates.m),
    )
    single = np.dtype(dtype) == np.float32
    still, near2 = (STILL, NEAR**2) if single else (_STILL, _NEAR2)
    gains = maximise(problem, starts_of(problem.gram), steps, still=still)[1]
    squared = 2 - 2 * (p @ q.T + gains.reshape(shape))
    out = np.sqrt(np.maximum(squared, 0))
    i, j = np.nonzero(squared < near2)
    out[i, j] = pairs(probes, templates, i, j, metric=Metric.SPHERICAL, steps=steps)
    return out


# --- the sphere, and two subspaces on it ----------------------------------------------------


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
    """Maximise g·u + h·v + uᵀBv over unit u and v, for K pairs.

    The best u of a v is known, so with G = BᵀB and c = Bᵀg it is to maximise F(v) = h·v + λ,
    λ² = ‖g‖² + 2 c·v + vᵀGv.
    """

    gram: Doubles
    """G, shape (K, m, m)."""
    c: Doubles
    h: Doubles
    """t E p, shape (K, m)."""
    g2: Doubles
    """‖g‖² of g = s D q, shape (K, 1)."""


def _problem(b: Doubles, g: Doubles, h: Doubles) -> Problem:
    """The problems of K pairs: their similarity is p·q + max F."""
    columns = b.transpose(0, 2, 1)
    g2 = np.einsum("ki,ki->k", g, g)[:, None]
    return Problem(columns @ b, _times(columns, g), h, g2)


def _problem_of(left: Rows, right: Rows) -> tuple[Doubles, Problem]:
    """Products p·q of K subspaces and as many others, (K,), and their problems."""
    (scale, s), (their_scale, t) = spheres(left.feet), spheres(right.feet)
    p, q = left.feet * scale[:, None], right.feet * their_scale[:, None]
    b = (s * t)[:, None, None] * (left.bases @ right.bases.transpose(0, 2, 1))
    g, h = s[:, None] * _times(left.bases, q), t[:, None] * _times(right.bases, p)
    return np.einsum("ki,ki->k", p, q), _problem(b, g, h)


def starts_of(gram: Doubles) -> Doubles:
    """Starts of v, shape (K, 2, m): the leading eigenvector of G with both signs.

    The objective has one or two local maxima, on either side of that vector, and its two signs
    lead to both: of 45,000 pairs of lifted faces, random subspaces and wolves one (in R⁸) ended
    more than 10⁻⁴ below random restarts. The vector is a column of a power of G, as good as the
    exact one, and cheaper.
    """
    power = gram
    for _ in range(5):
        power = power / np.maximum(np.einsum("kii->k", power), _TINY)[:, None, None]
        power = power @ power
    largest = np.argmax(np.einsum("kii->ki", power), axis=1)
    leading = _directions(power[np.arange(len(power)), :, largest])
    return np.stack([leading, -leading], axis=1)


def maximise(
    problem: Problem, starts: Doubles, steps: int, *, still: float = _STILL
) -> tuple[Doubles, Doubles]:
    """Best v over all starts (K, S, m), shape (K, m), and F(v), (K,).

    A pair rests when a step moves v by less than ``still``.

    One step is v ← normalise(h + (c + G v)/λ), which never lowers F. It converges linearly, slowly
    where two eigenvalues are close; an Anderson extrapolation of depth one through the last two
    steps mends that. Where the extrapolated point is worse than the last one, the plain step comes
    next instead.
    """
    v = starts
    best, values = v.copy(), np.full(v.shape[:2], -np.inf)
    active, moved, stepped = np.arange(len(v)), np.zeros_like(v), v
    trial, value = v, values
    for taken in range(steps):
        following, new = _step(problem, trial)
        worse = new < value
        motion = following - trial
        turn = motion - moved
        slope = np.einsum("ksi,ksi->ks", motion, turn)
        slope /= np.maximum(np.einsum("ksi,ksi->ks", turn, turn), _TINY)
        slope = np.clip(slope, -LONGEST, LONGEST)[:, :, None] * (taken > 0)
        again = worse[:, :, None]
        v = np.where(again, v, trial)
        trial = np.where(again, stepped, normalised(following - slope * (following - stepped)))
        moved, stepped = np.where(again, moved, motion), np.where(again, stepped, following)
        value = np.where(worse, value, new)
        done = (~worse & (np.einsum("ksi,ksi->ks", motion, motion) < still**2)).all(axis=1)
        if taken == steps - 1 or (taken % 4 == 3 and done.any()):
            done |= taken == steps - 1
            values[active[done]], best[active[done]] = value[done], v[done]
            left = ~done
            problem = Problem(*(part[left] for part in problem))
            active, moved, stepped, v, trial, value = (
                part[left] for part in (active, moved, stepped, v, trial, value)
            )
            if not active.size:
                break
    every, winner = np.arange(len(best)), np.argmax(values, axis=1)
    return best[every, winner], values[every, winner]


def _step(problem: Problem, v: Doubles) -> tuple[Doubles, Doubles]:
    """Following v of a v, shape (K, S, m), and the value at v, shape (K, S)."""
    turned = v @ problem.gram
    inside = turned + 2 * problem.c[:, None]
    lengths = np.sqrt(np.maximum(problem.g2 + np.einsum("ksi,ksi->ks", v, inside), _TINY))
    following = problem.h[:, None] + (turned + problem.c[:, None]) / lengths[:, :, None]
    return normalised(following), np.asarray(lengths + np.einsum("ksi,ki->ks", v, problem.h))


def _times(matrices: Doubles, rows: Doubles) -> Doubles:
    return np.asarray((matrices @ rows[..., None])[..., 0])
