"""Float32 distances of many pairs, on loops that numba compiles (extra ``evaluate``).

A tile is the product of the stacked rows [p; D] of some probes with the rows [q; E] of some
templates: one call of the matrix library. The loops below make distances of it. In every array
the pairs lie innermost, side by side as *lanes*, so that LLVM makes vector instructions of plain
loops. What float32 gets wrong is -1 in their result, and ``exact`` computes it.

The compiled code is cached by the text of this file. So all loops stand here, and a number of
another file comes as an argument.
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

from templates.distances import exact
from templates.distances.blas import single_threaded
from templates.distances.metric import (
    ACCURACY,
    LONGEST,
    NEAR,
    STILL,
    Array32,
    Metric,
    Probes,
    Tile,
    parts,
)
from templates.space.subspace import SubspaceBatch

# Rows of the product of a tile: 2 MiB, which a processor's cache holds.
_PROBE_ROWS, _TEMPLATE_ROWS = 512, 1024
# Pairs of a task, which bounds the memory of its result.
_TASK_PAIRS = 1 << 19
# Pairs of subspaces on the sphere that are solved side by side.
_MOST_LANES = 512

_EPS, _TINY = np.finfo(np.float32).eps, np.finfo(np.float32).tiny
_OVERFLOW = np.float32(1e38)
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
_TILT = np.float32(0.3)
# Multiplications by G before a start, and before those of a pair without proof.
_POWERS, _MORE_POWERS = 12, 48
_LONG = np.float32(1e18)
_LEAST_PIVOT = np.float32(3e-6)
# Values of the iteration that differ by less differ by rounding.
_NOISE = np.float32(1e-6)

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _compiled(function: _Function) -> _Function:
    fast = {"contract", "reassoc", "arcp", "nsz"}  # NaN and infinity keep their meaning
    return cast(
        _Function, njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function)
    )


def tiles(
    probes: Probes, templates: SubspaceBatch, *, metric: Metric, steps: int
) -> Iterator[Tile]:
    """Yield rows, columns and distances (R, C) float32 of all parts of the matrix, in order."""
    probes, terms = _prepared(probes, metric is Metric.SPHERICAL)
    with single_threaded() as count:
        most = max(1, _TEMPLATE_ROWS // (templates.m + 1))
        # As many parts as threads, or a multiple of it, in whole vectors.
        width = -(-len(templates) // (count * max(1, -(-len(templates) // (count * most)))))
        width = max(1, width + -width % 16)
        tasks = [
            (rows, columns)
            for columns in parts(len(templates), width)
            for rows in parts(len(probes), max(1, _TASK_PAIRS // width))
        ]

        def compute(rows: slice, columns: slice) -> Tile:
            some = probes[rows], terms[rows], templates[columns]
            return rows, columns, _task(*some, metric, steps)

        if count == 1 or len(tasks) == 1:
            yield from (compute(*task) for task in tasks)
            return
        waiting: deque[Future[Tile]] = deque()
        with ThreadPoolExecutor(count, thread_name_prefix="veilface-distances") as pool:
            for task in tasks:
                waiting.append(pool.submit(compute, *task))
                if len(waiting) > 2 * count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()


def _task(
    probes: Probes, terms: Array32, templates: SubspaceBatch, metric: Metric, steps: int
) -> Array32:
    """Distances of some probes to some templates, whose rows are stacked once."""
    spherical = metric is Metric.SPHERICAL
    m_d = probes.m if isinstance(probes, SubspaceBatch) else 0
    m_e, n, near = templates.m, templates.n, np.float32(NEAR)
    right = np.empty((m_e + 1, len(templates), n), dtype=np.float32)
    _stack(templates, spherical, right.transpose(1, 0, 2))  # all feet first
    squares = _float32(_squares(templates.feet))
    out = np.empty((len(probes), len(templates)), dtype=np.float32)
    step = max(1, _PROBE_ROWS // (m_d + 1))
    products = np.empty((step * (m_d + 1), right.size // n), dtype=np.float32)
    stacked = np.empty((step if m_d else 0, m_d + 1, n), dtype=np.float32)
    for rows in parts(len(probes), step):
        left, count = probes[rows], rows.stop - rows.start
        if isinstance(left, SubspaceBatch):
            _stack(left, spherical, stacked[:count])
            left = stacked[:count].reshape(-1, n)
        product = products[: len(left)]
        with np.errstate(over="ignore", invalid="ignore"):  # such pairs are computed again
            np.matmul(left, right.reshape(-1, n).T, out=product)
        product, tile = product.reshape(count, -1), out[rows]  # of whole rows, so contiguous
        if not m_d:
            _points(product, m_e, terms[rows], squares, spherical, near, tile)
        elif spherical:
            still, longest = np.float32(STILL), np.float32(LONGEST)
            _spherical(product, m_d, m_e, steps, near, still, longest, tile)
        else:
            _euclidean(product, m_d, m_e, terms[rows], squares, near, np.float32(ACCURACY), tile)
    i, j = np.nonzero(out < 0)
    if i.size:
        out[i, j] = exact.pairs(probes, templates, i, j, metric=metric, steps=steps)
    return out


def _prepared(probes: Probes, spherical: bool) -> tuple[Probes, Array32]:
    """Probes in float32, and ‖p‖² of each; or 1/‖e‖ of a point on the sphere, 0 of a zero."""
    if isinstance(probes, SubspaceBatch):
        return probes, _float32(_squares(probes.feet))
    points = np.ascontiguousarray(probes, dtype=np.float32)
    squares = _squares(points)
    if not spherical:
        return points, _float32(squares)
    if squares.size and not 1e-12 < squares.min() <= squares.max() < 1e12:  # beyond float32
        points = exact.normalised(points.astype(np.float64)).astype(np.float32)
        squares = np.asarray(squares > 0, dtype=np.float64)
    return points, _float32((squares > 0) / np.sqrt(np.maximum(squares, _TINY)))


def _float32(squares: NDArray[np.float64]) -> Array32:
    """Round; what is too large is infinite."""
    with np.errstate(over="ignore"):
        return squares.astype(np.float32)


def _stack(batch: SubspaceBatch, spherical: bool, out: Array32) -> None:
    """Write rows (N, m + 1, n) [p; D]; of the sphere, p in the unit ball and D times the radius."""
    if spherical:
        squares = _squares(batch.feet)
        scales = _float32(1 / np.sqrt(np.maximum(squares, 1)))
        radii = _float32(np.sqrt(np.maximum(1 - squares, 0)))
        np.multiply(batch.feet, scales[:, None], out=out[:, 0])
        np.multiply(batch.bases, radii[:, None, None], out=out[:, 1:])
    else:
        out[:, 0], out[:, 1:] = batch.feet, batch.bases


@_compiled
def _squares(rows: Array32) -> NDArray[np.float64]:
    """Squared lengths, (N,)."""
    out = np.zeros(len(rows))
    for i in range(len(rows)):
        for k in range(rows.shape[1]):
            x = np.float64(rows[i, k])
            out[i] += x * x
    return out


@_compiled
def _dot(
    total: Array32, x: Array32, of_x: int, by: int, y: Array32, of_y: int, to: int, count: int
) -> None:
    """Write Σ x[of_x + t·by] · y[of_y + t·to] over t < count, lane by lane, to ``total``."""
    lanes, t = len(total), count % 4
    # Indices without a sign: a negative one would count from the end, and no vector could be read.
    n = np.uintp(lanes)
    for k in range(n):
        total[k] = _ZERO
    for r in range(t):
        i, j = np.uintp(of_x + r * by), np.uintp(of_y + r * to)
        for k in range(n):
            total[k] += x[i + k] * y[j + k]
    while t < count:  # four at a time: the sum is read and written once for all
        i, i2 = np.uintp(of_x + t * by), np.uintp(of_x + (t + 2) * by)
        j, j2 = np.uintp(of_y + t * to), np.uintp(of_y + (t + 2) * to)
        i1, i3, j1, j3 = i + np.uintp(by), i2 + np.uintp(by), j + np.uintp(to), j2 + np.uintp(to)
        t += 4
        for k in range(n):
            total[k] += (
                x[i + k] * y[j + k] + x[i1 + k] * y[j1 + k]
                + x[i2 + k] * y[j2 + k] + x[i3 + k] * y[j3 + k]
            )  # fmt: skip


@_compiled
def _inner(total: Array32, x: Array32, y: Array32) -> None:
    """Write the inner products of two stacks of vectors (m, stride)."""
    m, stride = x.shape
    _dot(total, x.reshape(-1), 0, stride, y.reshape(-1), 0, stride, m)


@_compiled
def _normalise(v: Array32, inverse: Array32) -> None:
    """Multiply v by 1 / its length, which is written; where it is 0 the first axis does as well."""
    _inner(inverse, v, v)
    for k in range(len(inverse)):
        inverse[k] = _ONE / np.sqrt(max(inverse[k], _TINY))
    for r in range(len(v)):
        axis = _ONE if r == 0 else _ZERO
        for k in range(len(inverse)):
            v[r, k] = v[r, k] * inverse[k] if inverse[k] < _LONG else axis


@_compiled
def _points(
    product: Array32, m: int, terms: Array32, squares: Array32, spherical: bool,
    near: np.float32, out: Array32,
) -> None:  # fmt: skip
    """Squared, ‖e‖² + ‖q‖² − 2 e·q − ‖E e‖² (paper eq. 1), or 2 − 2 (e·q + ‖t E e‖)."""
    lanes = len(squares)
    inside = np.empty(lanes, dtype=np.float32)
    for i in range(len(out)):
        row, distances, term = product[i], out[i], terms[i]
        _dot(inside, row, lanes, lanes, row, lanes, lanes, m)
        for k in range(lanes):
            if spherical:
                x = _TWO - _TWO * term * (row[k] + np.sqrt(inside[k]))
            else:
                x = term + squares[k] - _TWO * row[k] - inside[k]
            distances[k] = np.sqrt(x) if near * near < x < _OVERFLOW else -_ONE


@_compiled
def _problems(
    row: Array32, m_d: int, m_e: int, gram: Array32, c: Array32, h: Array32, g2: Array32
) -> None:
    """Write G = MᵀM, c = Mᵀg, h and ‖g‖² of the pairs of one probe.

    M = D Eᵀ, g = D q and h = E p, or with D and E exchanged where m_e > m_d: G is the smaller.
    """
    m, width = gram.shape[0], gram.shape[2]
    high, across, down = m_d, width, (m_e + 1) * width
    if m_e > m_d:
        high, across, down = m_e, down, across
    _dot(g2, row, down, down, row, down, down, high)
    for r in range(m):
        x = down + (r + 1) * across
        h[r] = row[x - down : x - down + width]
        _dot(c[r], row, x, down, row, down, down, high)
        for s in range(r, m):
            _dot(gram[r, s], row, x, down, row, down + (s + 1) * across, down, high)
            if s > r:
                gram[s, r] = gram[r, s]


@_compiled
def _factorise(gram: Array32, factor: Array32, sound: Array32) -> None:
    """Write the Cholesky factor R of I − G = RᵀR, with 1/R on its diagonal.

    ``sound`` is 1 in the lanes where no pivot is lost in rounding, else 0.
    """
    m, lanes = gram.shape[1], gram.shape[2]
    flat, least = factor.reshape(-1), np.float32(100 * _EPS)
    sound[:] = _ONE
    for r in range(m):
        for s in range(r, m):
            x, g, inverse = factor[r, s], gram[r, s], factor[r, r]
            _dot(x, flat, r * lanes, m * lanes, flat, s * lanes, m * lanes, r)
            for k in range(lanes):
                if r == s:
                    pivot = _ONE - g[k] - x[k]
                    sound[k] = sound[k] if pivot > least else _ZERO
                    x[k] = _ONE / np.sqrt(max(pivot, least))
                else:
                    x[k] = -(g[k] + x[k]) * inverse[k]


@_compiled
def _euclidean(
    product: Array32, m_d: int, m_e: int, terms: Array32, squares: Array32,
    near: np.float32, accuracy: np.float32, out: Array32,
) -> None:  # fmt: skip
    """Squared, ‖p − q‖² − ‖g‖² − wᵀ(I − G)⁻¹w with w = h + c (paper eq. 2 to 9)."""
    lanes, m = len(squares), min(m_d, m_e)
    matrices = np.empty((2, m, m, lanes), dtype=np.float32)
    vectors = np.empty((4, m, lanes), dtype=np.float32)
    numbers = np.empty((4, lanes), dtype=np.float32)
    gram, factor, c, h = matrices[0], matrices[1], vectors[0], vectors[1]
    z, beta, g2, sound = vectors[2], vectors[3], numbers[0], numbers[1]
    total, sizes = numbers[2], numbers[3]
    flat, row = factor.reshape(-1), m * lanes
    for i in range(len(out)):
        _problems(product[i], m_d, m_e, gram, c, h, g2)
        _factorise(gram, factor, sound)
        for r in range(m):  # z = R⁻ᵀw
            _dot(total, flat, r * lanes, row, z.reshape(-1), 0, lanes, r)
            for k in range(lanes):
                z[r, k] = (c[r, k] + h[r, k] - total[k]) * factor[r, r, k]
        for r in range(m - 1, -1, -1):  # β = R⁻¹z
            after = r + 1
            _dot(
                total, flat, r * row + after * lanes, lanes, beta.reshape(-1), after * lanes, lanes,
                m - after,
            )  # fmt: skip
            for k in range(lanes):
                beta[r, k] = (z[r, k] - total[k]) * factor[r, r, k]
        _inner(total, z, z)
        _inner(sizes, beta, beta)
        for k in range(lanes):
            x = terms[i] + squares[k] - _TWO * product[i, k] - g2[k] - total[k]
            # An error of the products moves the square by that times the squares of β.
            error = np.float32(4 * _EPS) * (_ONE + _TWO * sizes[k])
            good = sound[k] > _ZERO and near * near < x < _OVERFLOW and error < accuracy * x
            out[i, k] = np.sqrt(x) if good else -_ONE


# --- the sphere: maximise F(v) = h·v + λ, λ² = ‖g‖² + 2 c·v + vᵀGv, over unit v -------------------
# A problem is an array (4, m + 1, lanes): the diagonal of a tridiagonal G, what stands beside it
# (from row 1 on, and a row of zeros), c and h.


@_compiled
def _reduce(gram: Array32, problem: Array32, at: int) -> None:
    """Reflect a problem (Householder) so that G is tridiagonal; gram is overwritten.

    ``problem`` holds c and h already; its lanes are those from ``at``.
    """
    m, lanes = gram.shape[0], gram.shape[2]
    numbers, u, q = np.empty((4, lanes), np.float32), np.empty_like(gram[0]), np.empty_like(gram[0])
    beta, alpha, total, flat = numbers[0], numbers[1], numbers[2], gram.reshape(-1)
    problem[1, 0, at : at + lanes], problem[1, m, at : at + lanes] = _ZERO, _ZERO
    for r in range(m):
        problem[0, r, at : at + lanes] = gram[r, r]
        first, left = r + 1, m - r - 1
        if not left:
            break
        place, by = (r * m + first) * lanes, lanes
        _dot(total, flat, place, by, flat, place, by, left)
        for k in range(lanes):
            x = gram[r, first, k]
            alpha[k] = -np.copysign(np.sqrt(total[k]), x)
            u[first, k] = x - alpha[k]
            beta[k] = total[k] - x * alpha[k]
            beta[k] = _ONE / beta[k] if beta[k] > _TINY else _ZERO
            problem[1, first, at + k] = alpha[k]
        u[first + 1 :] = gram[r, first + 1 :]
        total[:] = _ZERO
        for s in range(first, m):
            of_u = u.reshape(-1)
            _dot(q[s], flat, (s * m + first) * lanes, by, of_u, first * lanes, by, left)
            for k in range(lanes):
                q[s, k] *= beta[k]
                total[k] += q[s, k] * u[s, k]
        for s in range(first, m):
            for k in range(lanes):
                q[s, k] -= total[k] * beta[k] / _TWO * u[s, k]
        for s in range(first, m):
            for t in range(first, m):
                for k in range(lanes):
                    gram[s, t, k] -= u[s, k] * q[t, k] + q[s, k] * u[t, k]
        for which in range(2, 4):
            total[:] = _ZERO
            for s in range(first, m):
                for k in range(lanes):
                    total[k] += u[s, k] * problem[which, s, at + k]
            for s in range(first, m):
                for k in range(lanes):
                    problem[which, s, at + k] -= total[k] * beta[k] * u[s, k]


@_compiled
def _times(problem: Array32, v: Array32, w: Array32, lanes: int) -> None:
    """Write w = G v."""
    m = len(v)
    for r in range(m):
        before, after = max(r - 1, 0), min(r + 1, m - 1)
        for k in range(lanes):
            w[r, k] = problem[0, r, k] * v[r, k] + problem[1, r, k] * v[before, k]
            w[r, k] += problem[1, r + 1, k] * v[after, k]


@_compiled
def _advance(
    problem: Array32, g2: Array32, v: Array32, w: Array32,
    value: Array32, lam: Array32, mu: Array32,
) -> None:  # fmt: skip
    """Write the step w = normalise(h + (c + G v)/λ), F(v), 1/λ and 1/μ, μ the length."""
    lanes, m = len(value), len(v)
    c, h = problem[2], problem[3]
    _times(problem, v, w, lanes)
    value[:], lam[:] = _ZERO, g2[:lanes]
    for r in range(m):
        for k in range(lanes):
            value[k] += v[r, k] * h[r, k]
            lam[k] += v[r, k] * (w[r, k] + _TWO * c[r, k])
    for k in range(lanes):
        length = np.sqrt(max(lam[k], _TINY))
        value[k] += length
        lam[k] = _ONE / length
    for r in range(m):
        for k in range(lanes):
            w[r, k] = h[r, k] + (c[r, k] + w[r, k]) * lam[k]
    _normalise(w, mu)


@_compiled
def _start(
    problem: Array32, g2: Array32, lanes: int, powers: int, tilt: np.float32, v: Array32
) -> None:
    """Write nearly the leading eigenvector of G, with the sign whose F is the larger, to v."""
    m, w, numbers = len(v), np.empty_like(v), np.empty((4, lanes), dtype=np.float32)
    for r in range(m):
        v[r] = _ONE + tilt * np.float32((7 * r + 3) % 5 - 2)
    for _ in range(powers):
        _normalise(v, numbers[0])
        _times(problem, v, w, lanes)
        v, w = w, v
    _normalise(v, numbers[0])
    for sign in range(2):
        _advance(problem, g2, v, w, numbers[sign], numbers[2], numbers[3])
        v *= -_ONE
    for r in range(m):
        for k in range(lanes):
            v[r, k] = v[r, k] if numbers[0, k] >= numbers[1, k] else -v[r, k]


@_compiled
def _ascend(
    problem: Array32, g2: Array32, lanes: int, trial: Array32,
    where: NDArray[np.int64], steps: int, still: np.float32, longest: np.float32,
    best: Array32, lams: Array32, mus: Array32,
) -> None:  # fmt: skip
    """Accelerated alternation (``exact.maximise``) from ``trial``; lane k is pair where[k].

    Raises ``best``, and writes 1/λ and μ of pairs that came to rest, μ = 0 of the others. Lanes
    that rest make room, so all arguments before ``steps`` are overwritten.
    """
    m, stride = trial.shape
    vectors, numbers = np.zeros((3, m, stride), np.float32), np.empty((6, lanes), np.float32)
    stepped, moved, w = vectors[0], vectors[1], vectors[2]
    value, done = np.full(lanes, np.float32(-4)), np.zeros(lanes, dtype=np.bool_)
    for taken in range(steps):
        new, lam, mu = numbers[0, :lanes], numbers[1, :lanes], numbers[2, :lanes]
        top, bottom, motion = numbers[3, :lanes], numbers[4, :lanes], numbers[5, :lanes]
        _advance(problem, g2, trial, w, new, lam, mu)
        top[:], bottom[:], motion[:] = _ZERO, _ZERO, _ZERO
        for r in range(m):
            for k in range(lanes):
                x = w[r, k] - trial[r, k]
                turn = x - moved[r, k]
                top[k] += x * turn
                bottom[k] += turn * turn
                motion[k] += x * x
        for k in range(lanes):
            slope = min(max(top[k] / max(bottom[k], _TINY), -longest), longest)
            top[k] = slope if taken else _ZERO
            # Where the extrapolated point is worse than the last one, the plain step comes next.
            worse = new[k] < value[k] - _NOISE
            bottom[k] = _ONE if worse else _ZERO
            motion[k] = _ONE if worse else motion[k]
            value[k] = value[k] if worse else new[k]
        for r in range(m):
            for k in range(lanes):
                x, last, worse = w[r, k], stepped[r, k], bottom[k] > _ZERO
                moved[r, k] = moved[r, k] if worse else x - trial[r, k]
                stepped[r, k] = last if worse else x
                trial[r, k] = last if worse else x - top[k] * (x - last)
        _normalise(trial, new)
        if taken < steps - 1 and taken % 4 < 3:
            continue
        resting = 0
        for k in range(lanes):
            rests = motion[k] < still * still
            if not done[k] and (rests or taken == steps - 1):
                done[k], pair = True, where[k]
                best[pair] = max(best[pair], value[k])
                lams[pair], mus[pair] = lam[k], _ONE / mu[k] if rests else _ZERO
            resting += done[k]
        if resting == lanes:
            break
        if 4 * resting < lanes:
            continue
        free = 0
        for k in range(lanes):
            if not done[k]:
                _move(problem, k, problem, free)
                g2[free] = g2[k]
                where[free], value[free], done[free] = where[k], value[k], False
                for r in range(m):
                    trial[r, free], stepped[r, free] = trial[r, k], stepped[r, k]
                    moved[r, free] = moved[r, k]
                free += 1
        lanes = free


@_compiled
def _move(problem: Array32, lane: int, to: Array32, place: int) -> None:
    """Copy one lane of a problem."""
    for r in range(problem.shape[1]):
        for which in range(4):
            to[which, r, place] = problem[which, r, lane]


@_compiled
def _finish(
    waiting: Array32, numbers: Array32, places: NDArray[np.int64], count: int, steps: int,
    still: np.float32, longest: np.float32, similarities: Array32,
) -> None:  # fmt: skip
    """Solve problems from both signs of another start; ``numbers`` are their ‖g‖² and p·q.

    The first start may be orthogonal to the leading eigenvector, so this one is tilted.
    """
    v, rest = np.empty_like(waiting[0, 1:]), np.empty_like(numbers)
    best = np.full(count, np.float32(-4))
    _start(waiting, numbers[0], count, _MORE_POWERS, _TILT, v)
    for sign in (_ONE, -_ONE):
        _ascend(
            waiting.copy(), numbers[0].copy(), count, sign * v, np.arange(count), steps, still,
            longest, best, rest[0], rest[1],
        )  # fmt: skip
    for k in range(count):
        x = numbers[1, k] + best[k]
        similarities[places[k]] = max(similarities[places[k]], x)


@_compiled
def _spherical(
    product: Array32, m_d: int, m_e: int, steps: int,
    near: np.float32, still: np.float32, longest: np.float32, out: Array32,
) -> None:  # fmt: skip
    """Distances from p·q + max F, with proof that it is the maximum, or the best of two starts.

    Where S = μI − G/λ is positive definite at rest, Lagrangian duality bounds F by its value
    there (docs/method.md §3.5). Pairs without that proof are gathered, and begin again.
    """
    width, m = out.shape[1], min(m_d, m_e)
    step = max(1, _MOST_LANES // width)
    size = step * width
    gram, v = np.empty((m, m, width), np.float32), np.empty((m, size), np.float32)
    problems, numbers = np.empty((3, 4, m + 1, size), np.float32), np.empty((5, size), np.float32)
    problem, work, waiting = problems[0], problems[1], problems[2]
    of_waiting, places, count = np.empty((2, size), np.float32), np.empty(size, np.int64), 0
    similarities = out.reshape(-1)
    for first in range(0, len(out), step):
        lanes = min(step, len(out) - first) * width
        g2, best, lam = numbers[0, :lanes], numbers[1, :lanes], numbers[2, :lanes]
        mu, sound = numbers[3, :lanes], numbers[4, :lanes]
        for at in range(0, lanes, width):
            c, h = problem[2, :, at : at + width], problem[3, :, at : at + width]
            _problems(product[first + at // width], m_d, m_e, gram, c, h, g2[at : at + width])
            _reduce(gram, problem, at)
        _start(problem, g2, lanes, _POWERS, _ZERO, v)
        work[:], best[:] = problem, np.float32(-4)
        _ascend(work, g2.copy(), lanes, v, np.arange(lanes), steps, still, longest, best, lam, mu)
        sound[:], pivot = _ONE, np.ones(lanes, dtype=np.float32)
        for r in range(m):
            for k in range(lanes):
                x = problem[1, r, k] * lam[k]
                x = mu[k] - problem[0, r, k] * lam[k] - x * x / pivot[k]
                sound[k] = sound[k] if x > _LEAST_PIVOT * mu[k] else _ZERO
                pivot[k] = max(x, _TINY)
        for k in range(lanes):
            place, dot = first * width + k, product[first + k // width, k % width]
            similarities[place] = dot + best[k]
            if sound[k] > _ZERO:
                continue
            _move(problem, k, waiting, count)
            of_waiting[0, count], of_waiting[1, count], places[count] = g2[k], dot, place
            count += 1
            if count == size:
                _finish(waiting, of_waiting, places, count, steps, still, longest, similarities)
                count = 0
    if count:
        _finish(waiting, of_waiting, places, count, steps, still, longest, similarities)
    for k in range(len(similarities)):
        x = _TWO - _TWO * similarities[k]
        similarities[k] = np.sqrt(x) if x > near * near else -_ONE
