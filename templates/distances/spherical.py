"""Distances between the parts of points and subspaces that lie on the unit sphere.

See docs/method.md §3.4 and §3.5.

Descriptors are of unit length, so only the points of a subspace at unit length can be one. A
subspace with foot point p meets the unit sphere in a sphere around p of radius s = √(1 − ‖p‖²).
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from templates.distances.crossgram import (
    Floats,
    Indices,
    Kind,
    PairTile,
    chunks,
    matched_tiles,
    pair_tiles,
    point_tiles,
)
from templates.space.subspace import SubspaceBatch

NEAR = 0.1
"""Distances below this are computed again in float64: 2 − 2 sim cancels in float32."""

# A pair is finished when a step moves v by less than this; what is left of the similarity is of
# the order of its square. By bytes of the numbers.
_STILL = {4: 3e-5, 8: 1e-10}
# Extrapolations longer than this are rounding noise.
_LONGEST = 1e3
_ITERATION_BYTES = 2 << 20


class Spheres(NamedTuple):
    """Intersections with the unit sphere.

    A set that misses the sphere (‖p‖ > 1) holds no descriptor. It is replaced by its foot point's
    direction, so that no similarity exceeds 1.
    """

    scales: NDArray[np.float64]
    """Factors of the foot points, 1 or 1/‖p‖."""
    radii: NDArray[np.float64]


def spheres(batch: SubspaceBatch) -> Spheres:
    """Return where the sets of a batch meet the unit sphere."""
    norms = batch.foot_norms
    return Spheres(1 / np.maximum(norms, 1), np.sqrt(np.maximum(1 - norms**2, 0)))


def _normalised(rows: Floats) -> Floats:
    """Unit rows along the last axis; a zero row stays zero."""
    norms = np.sqrt(np.einsum("...i,...i->...", rows, rows))[..., None]
    return np.asarray(rows / np.maximum(norms, np.finfo(rows.dtype).tiny))


def directions(points: NDArray[np.float32]) -> NDArray[np.float32]:
    """Unit rows; a zero row stays zero."""
    return _normalised(points.astype(np.float64)).astype(np.float32)


def _distances(similarities: Floats) -> Floats:
    return np.asarray(np.sqrt(np.maximum(2 - 2 * similarities, 0)))


def points_pairwise(points: Floats, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of the directions of points (P, n) to templates, shape (P, T)."""
    out = np.empty((len(points), len(templates)), dtype=dtype)
    directions = _normalised(points.astype(np.float64)).astype(dtype)
    scales, radii = (part.astype(dtype) for part in spheres(templates))
    for rows, columns, dots, spreads in point_tiles(directions, templates, dtype):
        dots *= scales[columns, None]
        np.sqrt(spreads, out=spreads)
        spreads *= radii[columns, None]
        spreads += dots
        out[rows, columns] = _distances(spreads).T
    i, j = np.nonzero(out < NEAR)
    if i.size:
        out[i, j] = points_exact(points, templates, i, j)
    return out


def points_paired(points: Floats, templates: SubspaceBatch, dtype: Kind) -> Floats:
    """Distances of the direction of point i to template i, shape (P,)."""
    every = np.arange(len(points))
    return points_exact(points, templates, every, every).astype(dtype)


def points_exact(
    points: Floats, templates: SubspaceBatch, i: Indices, j: Indices
) -> NDArray[np.float64]:
    """Distances of points ``i`` to templates ``j`` from explicit differences in float64."""
    out = np.empty(len(i))
    for part in chunks(len(i), templates.m * templates.n):
        some = templates[j[part]]
        scales, radii = spheres(some)
        bases = some.bases.astype(np.float64)
        units = _normalised(points[i[part]].astype(np.float64))
        inside = (units[:, None, :] @ bases.transpose(0, 2, 1) @ bases)[:, 0, :]
        nearest = some.feet * scales[:, None] + radii[:, None] * _normalised(inside)
        gaps = np.linalg.norm(units - nearest, axis=1)
        # A zero probe has no direction: similarity 0 with everything.
        out[part] = np.where(units.any(axis=1), gaps, np.sqrt(2.0))
    return out


def subspaces_pairwise(
    probes: SubspaceBatch, templates: SubspaceBatch, steps: int, dtype: Kind
) -> Floats:
    """Distances of all probes to all templates, shape (P, T)."""
    out = np.empty((len(probes), len(templates)), dtype=dtype)
    both = spheres(probes), spheres(templates)
    for tile in pair_tiles(probes, templates, dtype):
        distances = _tile(probes, templates, tile, *both, steps)
        out[tile.first, tile.second] = distances
    return out


def subspaces_paired(
    probes: SubspaceBatch, templates: SubspaceBatch, steps: int, dtype: Kind
) -> Floats:
    """Distances of probe i to template i, shape (P,)."""
    out = np.empty(len(probes), dtype=dtype)
    both = spheres(probes), spheres(templates)
    for tile in matched_tiles(probes, templates, dtype):
        out[tile.first] = _tile(probes, templates, tile, *both, steps)
    return out


class Problem(NamedTuple):
    """Maximise g·u + h·v + uᵀBv over unit u and v, for K pairs."""

    g: Floats
    """s D q, shape (K, m_D)."""
    h: Floats
    """t E p, shape (K, m_E)."""
    b: Floats
    """s t D Eᵀ, shape (K, m_D, m_E)."""
    transposed: Floats
    """Bᵀ, contiguous: small products with a transposed view are four times slower."""

    @classmethod
    def of(cls, g: Floats, h: Floats, b: Floats) -> Self:
        """Keep the transposed matrix too."""
        return cls(g, h, b, np.ascontiguousarray(b.transpose(0, 2, 1)))

    def take(self, index: slice | Indices) -> Self:
        """Return some of the pairs."""
        return type(self)(*(part[index] for part in self))


def _tile(
    probes: SubspaceBatch,
    templates: SubspaceBatch,
    tile: PairTile,
    mine: Spheres,
    theirs: Spheres,
    steps: int,
) -> Floats:
    dots, problem = problem_of(tile, mine, theirs)
    count, m_d, m_e = problem.b.shape
    gains = np.empty_like(dots)
    step = max(1, _ITERATION_BYTES // ((m_d + 8) * (m_e + 8) * dots.dtype.itemsize))
    for start in range(0, count, step):
        part = slice(start, min(start + step, count))
        some = problem.take(part)
        gains[part], _ = maximise(some, _starts(some), steps)
    distances = _distances(dots + gains)
    near = np.flatnonzero(distances < NEAR)
    if near.size:
        distances[near] = subspaces_exact(
            probes, templates, tile.first[near], tile.second[near], steps
        )
    return distances


def problem_of(tile: PairTile, mine: Spheres, theirs: Spheres) -> tuple[Floats, Problem]:
    """Products p·q of the pairs of a tile, (K,), and the problems of the rest of the similarity."""
    dtype = tile.dots.dtype
    i, j = tile.first, tile.second
    s, t = mine.radii[i].astype(dtype), theirs.radii[j].astype(dtype)
    p, q = mine.scales[i].astype(dtype), theirs.scales[j].astype(dtype)
    problem = Problem.of(
        (s * q)[:, None] * tile.left,
        (t * p)[:, None] * tile.right,
        (s * t)[:, None, None] * tile.middle,
    )
    return p * q * tile.dots, problem


def _starts(problem: Problem) -> Floats:
    """Starts of v, shape (K, 2, m_E): the leading right singular vector of B with both signs.

    The objective has one or two local maxima, on either side of that vector, and its two signs
    lead to both: of 45,000 pairs of lifted faces, random subspaces and wolves one (in R⁸) ended
    more than 10⁻⁴ below random restarts. The vector is a column of a power of BᵀB, as good as the
    exact one, and cheaper.
    """
    power = problem.transposed @ problem.b
    tiny = np.finfo(power.dtype).tiny
    for _ in range(5):
        power /= np.maximum(np.einsum("kii->k", power), tiny)[:, None, None]
        power = power @ power
    largest = np.argmax(np.einsum("kii->ki", power), axis=1)
    leading = _normalised(power[np.arange(len(power)), :, largest])
    return np.stack([leading, -leading], axis=1)


def maximise(problem: Problem, starts: Floats, steps: int) -> tuple[Floats, Floats]:
    """Best value over all starts, shape (K,), and its v, shape (K, m_E).

    One step is u ← normalise(g + B v), v ← normalise(h + Bᵀu), which never lowers the value. It
    converges linearly, slowly where two singular values are close; an Anderson extrapolation of
    depth one through the last two steps mends that. Where the extrapolated point is worse than
    the last one, the plain step is taken instead, so the value rises in every step.
    """
    count = len(starts)
    values = np.empty(starts.shape[:2], dtype=starts.dtype)
    best_v = starts.copy()
    active = np.arange(count)
    still = _STILL[starts.dtype.itemsize] ** 2
    tiny = np.finfo(starts.dtype).tiny
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
        slope /= np.maximum(np.einsum("ksi,ksi->ks", turn, turn), tiny)
        np.clip(slope, -_LONGEST, _LONGEST, out=slope)
        v, value, moved = trial, next_value, next_moved
        trial = _normalised(next_stepped - slope[:, :, None] * (next_stepped - stepped))
        stepped = next_stepped
        if taken % 4 == 0:
            distance = np.einsum("ksi,ksi->ks", moved, moved)
            done = (distance < still).all(axis=1)
            if done.any():
                values[active[done]], best_v[active[done]] = value[done], v[done]
                left = np.flatnonzero(~done)
                active, problem = active[left], problem.take(left)
                v, value, moved = v[left], value[left], moved[left]
                trial, stepped = trial[left], stepped[left]
                if not left.size:
                    break
    values[active], best_v[active] = value, v
    winner = np.argmax(values, axis=1)
    every = np.arange(count)
    return values[every, winner], best_v[every, winner]


def _step(problem: Problem, v: Floats) -> tuple[Floats, Floats]:
    """Value at v with the best u, shape (K, S), and the next v, shape (K, S, m_E)."""
    u = v @ problem.transposed
    u += problem.g[:, None, :]
    norms = np.sqrt(np.einsum("ksi,ksi->ks", u, u))
    u /= np.maximum(norms, np.finfo(u.dtype).tiny)[:, :, None]
    norms += np.einsum("ksi,ki->ks", v, problem.h)
    following = u @ problem.b
    following += problem.h[:, None, :]
    return norms, _normalised(following)


def subspaces_exact(
    probes: SubspaceBatch, templates: SubspaceBatch, i: Indices, j: Indices, steps: int
) -> NDArray[np.float64]:
    """Distances of close pairs: iterate in float64 and subtract the closest points."""
    out = np.empty(len(i))
    for part in chunks(len(i), 2 * (probes.m + templates.m) * probes.n):
        a, b = probes[i[part]], templates[j[part]]
        mine, theirs = spheres(a), spheres(b)
        d, e = a.bases.astype(np.float64), b.bases.astype(np.float64)
        p, q = a.feet * mine.scales[:, None], b.feet * theirs.scales[:, None]
        s, t = mine.radii[:, None], theirs.radii[:, None]
        columns = e.transpose(0, 2, 1)
        problem = Problem.of(
            s * (q[:, None, :] @ d.transpose(0, 2, 1))[:, 0, :],
            t * (p[:, None, :] @ columns)[:, 0, :],
            (s * t)[:, :, None] * (d @ columns),
        )
        _, best = maximise(problem, _starts(problem), steps)
        u = _normalised(problem.g + (problem.b @ best[:, :, None])[:, :, 0])
        best = _normalised(problem.h + (u[:, None, :] @ problem.b)[:, 0, :])
        x = p + s * _normalised((u[:, None, :] @ d)[:, 0, :])
        y = q + t * _normalised((best[:, None, :] @ e)[:, 0, :])
        out[part] = np.linalg.norm(x - y, axis=1)
    return out
