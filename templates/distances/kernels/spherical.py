"""Spherical distances of pairs of subspaces from a tile of the cross-Gram matrix.

See docs/method.md §3.5.

With the rows [p; s D] and [q; t E] the tile holds p·q, g = s D q, h = t E p and B = s t D Eᵀ, and
the similarity is p·q + max g·u + h·v + uᵀBv over unit u and v. The best u of a v is known, so with
G = BᵀB and c = Bᵀg the objective is F(v) = h·v + λ, λ² = ‖g‖² + 2 c·v + vᵀGv, and one step of the
alternation is v ← normalise(h + (c + Gv)/λ).

For multipliers λ and μ with S = μI − G/λ positive definite, Lagrangian duality bounds the maximum
from above: by (λ + μ + g·u + h·v)/2 with v = S⁻¹(h + c/λ) and u = (g + Bv)/λ. At the minimum of the
bound both are of length one, and there it is attained, if anywhere. So a few steps of the
alternation, from the better sign of G's leading eigenvector, give λ and μ; Newton's method on
1/‖u‖ = 1/‖v‖ = 1 (Hebden 1973, Moré and Sorensen 1983, here in two variables) improves them; and a
pair whose bound and value agree is finished, with proof. Where they do not, the bound is not
attained or the system is nearly singular: those pairs, gathered into vectors of their own, take the
accelerated alternation from both starts of the reference (``exact``). Where one of
the subspaces is a line or a plane, v is a sign or an angle, and the angle is sampled.
"""

import numpy as np

from templates.distances.kernels.arguments import Array32, Integers, Options, Result, Tile
from templates.distances.kernels.lanes import (
    ALL,
    LANES,
    Lanes,
    blend,
    compiled,
    every,
    fma,
    fma4,
    inlined,
    larger,
    less,
    load,
    put,
    root,
    smaller,
    store,
    store4,
)
from templates.distances.metric import LONGEST, STILL

_PAD = 4
_TINY = np.float32(np.finfo(np.float32).tiny)
_PLAIN = 8
_NEWTON = 4
_GAP = np.float32(2e-6)
_LEAST_PIVOT = np.float32(3e-6)
_POWERS = 16
_STILL2 = np.float32(STILL**2)
_LONGEST = np.float32(LONGEST)
# Half a circle in eight parts.
_COSINES = tuple(np.float32(np.cos(np.pi * k / 16)) for k in range(-7, 9))
_SINES = tuple(np.float32(np.sin(np.pi * k / 16)) for k in range(-7, 9))
_CIRCLE_STEPS = 4
_LONGEST_TURN = np.float32(0.2)


def scratch_size(m_d: int, m_e: int) -> int:
    """Numbers of working space that :func:`spherical_subspaces` needs."""
    high, low = max(m_d, m_e), min(m_d, m_e)
    stride = low + _PAD
    problem = (low + 2) * stride
    return LANES * (high * stride + 2 * problem + stride * stride + 10 * stride + 3)


# A problem is stride = m + 4 numbers a row: m rows of G, c with ‖g‖² behind it, and h.


@inlined
def _products(work: Array32, problem: int, v: int, w: int, m: int) -> tuple[Lanes, Lanes, Lanes]:
    """Write w = G v; return h·v, c·v and v·w."""
    stride = m + _PAD
    zero = every(np.float32(0))
    of_c = problem + m * stride * LANES
    of_h = of_c + stride * LANES
    for r in range(0, m, _PAD):
        sums = zero, zero, zero, zero
        for k in range(m):
            # G is symmetric, so the four rows lie side by side.
            place = problem + (k * stride + r) * LANES
            sums = fma4(work, place, LANES, load(work, v + k * LANES), sums)
        store4(work, w + r * LANES, LANES, sums)
    hv, cv, vw = zero, zero, zero
    for k in range(m):
        x = load(work, v + k * LANES)
        hv = fma(load(work, of_h + k * LANES), x, hv)
        cv = fma(load(work, of_c + k * LANES), x, cv)
        vw = fma(load(work, w + k * LANES), x, vw)
    return hv, cv, vw


@inlined
def _advance(
    work: Array32, problem: int, v: int, following: int, m: int
) -> tuple[Lanes, Lanes, Lanes]:
    """Write the next step of the alternation after v; return F(v), λ and λμ, μ = ‖h + Bᵀu‖."""
    stride = m + _PAD
    of_c = problem + m * stride * LANES
    of_h = of_c + stride * LANES
    zero, tiny = every(np.float32(0)), every(_TINY)
    hv, cv, vw = _products(work, problem, v, following, m)
    squared = load(work, of_c + m * LANES) + cv + cv + vw
    lam = root(larger(squared, tiny))
    length = zero
    for k in range(m):
        # λ times the step: it is normalised anyway.
        x = load(work, of_c + k * LANES) + load(work, following + k * LANES)
        x = fma(lam, load(work, of_h + k * LANES), x)
        store(work, following + k * LANES, x)
        length = fma(x, x, length)
    length = root(length)
    _scale(work, following, every(np.float32(1)) / larger(length, tiny), m)
    return hv + lam, lam, length


@inlined
def _scale(work: Array32, v: int, factor: Lanes, m: int) -> None:
    for k in range(m):
        store(work, v + k * LANES, load(work, v + k * LANES) * factor)


@inlined
def _normalise(work: Array32, v: int, m: int) -> None:
    length = every(np.float32(0))
    for k in range(m):
        x = load(work, v + k * LANES)
        length = fma(x, x, length)
    _scale(work, v, every(np.float32(1)) / larger(root(length), every(_TINY)), m)


@inlined
def _keep(work: Array32, bits: int, chosen: int, other: int, m: int) -> None:
    """Overwrite ``other`` with ``chosen`` in the lanes of ``bits``."""
    for k in range(m):
        place = other + k * LANES
        store(work, place, blend(bits, load(work, chosen + k * LANES), load(work, place)))


@inlined
def _factorise(
    work: Array32, problem: int, factor: int, inverses: int, lam: Lanes, mu: Lanes, m: int
) -> int:
    """Cholesky factor R of S = RᵀR; return the bits of the lanes where S is positive definite."""
    stride = m + _PAD
    zero, scale = every(np.float32(0)), every(np.float32(-1)) / lam
    least = every(_LEAST_PIVOT) * mu
    sound = ALL
    for k in range(m):
        for r in range(k, m, _PAD):
            sums = mu if r == k else zero, zero, zero, zero
            sums = fma4(work, problem + (k * stride + r) * LANES, LANES, scale, sums)
            for t in range(k):
                x = zero - load(work, factor + (t * stride + k) * LANES)
                sums = fma4(work, factor + (t * stride + r) * LANES, LANES, x, sums)
            store4(work, factor + (k * stride + r) * LANES, LANES, sums)
        pivot = load(work, factor + (k * stride + k) * LANES)
        sound &= less(least, pivot)
        inverse = every(np.float32(1)) / root(larger(pivot, least))
        store(work, inverses + k * LANES, inverse)
        for r in range(k + 1, m):
            place = factor + (k * stride + r) * LANES
            store(work, place, load(work, place) * inverse)
    return sound


@inlined
def _solve(work: Array32, factor: int, inverses: int, x: int, m: int) -> None:
    """Replace x by S⁻¹x."""
    stride = m + _PAD
    for k in range(m):
        z = load(work, x + k * LANES) * load(work, inverses + k * LANES)
        store(work, x + k * LANES, z)
        for r in range(k + 1, m):
            place = x + r * LANES
            store(
                work, place, load(work, place) - load(work, factor + (k * stride + r) * LANES) * z
            )
    for k in range(m - 1, -1, -1):
        z = load(work, x + k * LANES) * load(work, inverses + k * LANES)
        store(work, x + k * LANES, z)
        for t in range(k):
            place = x + t * LANES
            store(
                work, place, load(work, place) - load(work, factor + (t * stride + k) * LANES) * z
            )


@compiled
def _start(work: Array32, problem: int, v: int, w: int, m: int, powers: int) -> None:
    """Write a power of G times its largest column, nearly its leading eigenvector, into v.

    Its sign is the one with the larger F. ``powers`` is even: v and w exchange their parts.
    """
    stride = m + _PAD
    of_c = problem + m * stride * LANES
    zero, one, tiny = every(np.float32(0)), every(np.float32(1)), every(_TINY)
    most, trace = every(np.float32(-1)), zero
    for k in range(m):
        row = problem + k * stride * LANES
        length = zero
        for r in range(m):
            x = load(work, row + r * LANES)
            length = fma(x, x, length)
        _keep(work, less(most, length), row, v, m)
        most = larger(most, length)
        trace = trace + load(work, row + k * LANES)
    # Divided by the trace, G makes nothing longer, and nothing of use shorter than by m.
    scale = one / larger(trace, tiny)
    for _ in range(powers):
        _products(work, problem, v, w, m)
        _scale(work, w, scale, m)
        v, w = w, v
    _normalise(work, v, m)
    hv, cv, vw = _products(work, problem, v, w, m)
    squared = load(work, of_c + m * LANES) + vw
    there = root(larger(squared + cv + cv, zero)) + hv
    back = root(larger(squared - cv - cv, zero)) - hv
    _scale(work, v, blend(less(there, back), every(np.float32(-1)), one), m)


@compiled
def _ascend(
    work: Array32, problem: int, free: int, v: int, m: int, steps: int, guarded: bool
) -> tuple[Lanes, Lanes, Lanes]:
    """Accelerated alternation from v; return the last value, λ and μ."""
    size = (m + _PAD) * LANES
    stepped, moved, trial = free, free + size, free + 2 * size
    following, motion = free + 3 * size, free + 4 * size
    zero, one, tiny = every(np.float32(0)), every(np.float32(1)), every(_TINY)
    value, lam, both = _advance(work, problem, v, stepped, m)
    for k in range(m):
        x = load(work, stepped + k * LANES)
        store(work, moved + k * LANES, x - load(work, v + k * LANES))
        store(work, trial + k * LANES, x)
    resting = 0
    for taken in range(1, steps):
        next_value, lam, both = _advance(work, problem, trial, following, m)
        worse = less(next_value, value) & ~resting
        if guarded and taken > 1 and worse:
            _keep(work, worse, stepped, trial, m)
            next_value, lam, both = _advance(work, problem, trial, following, m)
        top, bottom, distance = zero, zero, zero
        for k in range(m):
            x = load(work, following + k * LANES) - load(work, trial + k * LANES)
            turn = x - load(work, moved + k * LANES)
            store(work, motion + k * LANES, x)
            top = fma(x, turn, top)
            bottom = fma(turn, turn, bottom)
            distance = fma(x, x, distance)
        slope = top / larger(bottom, tiny)
        slope = smaller(larger(slope, every(-_LONGEST)), every(_LONGEST))
        value = blend(resting, value, next_value)
        resting |= less(distance, every(_STILL2))
        if resting == ALL:
            break
        length = zero
        for k in range(m):
            x = load(work, following + k * LANES)
            y = x - slope * (x - load(work, stepped + k * LANES))
            store(work, trial + k * LANES, y)
            store(work, stepped + k * LANES, x)
            length = fma(y, y, length)
        _scale(work, trial, one / larger(root(length), tiny), m)
        moved, motion = motion, moved
    return value, larger(lam, tiny), larger(both / lam, tiny)


@compiled
def _prove(work: Array32, problem: int, free: int, m: int, steps: int) -> tuple[Lanes, int]:
    """Plain steps, then Newton's on the bound; return the value found and the proven lanes."""
    stride = m + _PAD
    size = stride * LANES
    of_c = problem + m * size
    of_h = of_c + size
    factor = free
    inverses = factor + stride * size
    v, w, q, y = inverses + size, inverses + 2 * size, inverses + 3 * size, inverses + 4 * size
    zero, one, tiny = every(np.float32(0)), every(np.float32(1)), every(_TINY)
    half, many = every(np.float32(0.5)), every(np.float32(1.1))
    g2 = load(work, of_c + m * LANES)
    _start(work, problem, v, w, m, min(m + m % 2, _POWERS))
    best, lam, mu = _ascend(work, problem, factor, v, m, min(_PLAIN, steps), False)
    if steps <= _PLAIN:
        return best, 0
    good_lam, good_mu = lam, mu
    seen = proven = 0
    for turn in range(_NEWTON):
        sound = _factorise(work, problem, factor, inverses, lam, mu, m)
        inverse = one / lam
        for k in range(m):
            x = fma(load(work, of_c + k * LANES), inverse, load(work, of_h + k * LANES))
            store(work, v + k * LANES, x)
        _solve(work, factor, inverses, v, m)
        hv, cv, vw = _products(work, problem, v, w, m)
        v2 = zero
        for k in range(m):
            x = load(work, v + k * LANES)
            v2 = fma(x, x, v2)
        v2 = larger(v2, tiny)
        v1 = root(v2)
        bound = half * (lam + mu + hv + (g2 + cv) * inverse)
        value = (hv + root(larger(g2 * v2 + (cv + cv) * v1 + vw, zero))) / v1
        best = blend(sound & less(best, value), value, best)
        proven |= sound & less(bound - best, every(_GAP))
        if proven == ALL or turn == _NEWTON - 1:
            break
        u2 = larger((g2 + cv + cv + vw) * inverse * inverse, tiny)
        u1 = root(u2)
        inverse2 = inverse * inverse
        for k in range(m):
            x = load(work, of_c + k * LANES) + load(work, w + k * LANES)
            store(work, w + k * LANES, x)
            store(work, q + k * LANES, x * inverse2)
            store(work, y + k * LANES, load(work, v + k * LANES))
        _solve(work, factor, inverses, q, m)
        _solve(work, factor, inverses, y, m)
        uu, uv, vv = zero, zero, zero
        for k in range(m):
            x = load(work, v + k * LANES)
            along = load(work, q + k * LANES)
            uu = fma(load(work, w + k * LANES), along, uu)
            uv = fma(x, along, uv)
            vv = fma(x, load(work, y + k * LANES), vv)
        uu = fma(uu, inverse, u2) * inverse
        # Newton's step on (1/‖u‖ − 1, 1/‖v‖ − 1), whose rows are multiplied by ‖u‖³ and ‖v‖³.
        of_u, of_v = u2 - u2 * u1, v2 - v2 * v1
        determinant = uu * vv - uv * uv
        next_lam = lam - (vv * of_u - uv * of_v) / determinant
        next_mu = mu - (uu * of_v - uv * of_u) / determinant
        next_lam = larger(next_lam, every(np.float32(0.3)) * lam)
        next_mu = larger(next_mu, every(np.float32(0.3)) * mu)
        back_lam = blend(seen, half * (lam + good_lam), many * lam)
        back_mu = blend(seen, half * (mu + good_mu), many * mu)
        good_lam, good_mu = blend(sound, lam, good_lam), blend(sound, mu, good_mu)
        seen |= sound
        lam, mu = blend(sound, next_lam, back_lam), blend(sound, next_mu, back_mu)
    return best, proven


@inlined
def _of_one(work: Array32, problem: int) -> Lanes:
    """Maximum over v = ±1, where one subspace is a line."""
    row = (1 + _PAD) * LANES
    g, c = load(work, problem), load(work, problem + row)
    g2, h = load(work, problem + row + LANES), load(work, problem + 2 * row)
    zero = every(np.float32(0))
    there = root(larger(g2 + g + c + c, zero)) + h
    back = root(larger(g2 + g - c - c, zero)) - h
    return larger(there, back)


@inlined
def _of_two(work: Array32, problem: int) -> Lanes:
    """Maximum over v on the circle: its best samples on either side of G's larger column."""
    row = (2 + _PAD) * LANES
    g11, g12 = load(work, problem), load(work, problem + LANES)
    g22 = load(work, problem + row + LANES)
    c1, c2 = load(work, problem + 2 * row), load(work, problem + 2 * row + LANES)
    g2 = load(work, problem + 2 * row + 2 * LANES)
    h1, h2 = load(work, problem + 3 * row), load(work, problem + 3 * row + LANES)
    zero, one, tiny = every(np.float32(0)), every(np.float32(1)), every(_TINY)
    first = less(g22, g11)
    a1, a2 = blend(first, g11, g12), blend(first, g12, g22)
    length = root(fma(a1, a1, a2 * a2))
    scale = one / larger(length, tiny)
    # G = 0 has no larger column; any axis will do.
    a1, a2 = blend(less(tiny, length), a1 * scale, one), a2 * scale
    there, back = every(np.float32(-4)), every(np.float32(-4))
    x1, x2, y1, y2 = a1, a2, a1, a2
    for k in range(len(_COSINES)):
        cosine, sine = every(_COSINES[k]), every(_SINES[k])
        v1, v2 = cosine * a1 - sine * a2, fma(cosine, a2, sine * a1)
        hv, cv = fma(h1, v1, h2 * v2), fma(c1, v1, c2 * v2)
        squared = fma(v1, fma(g11, v1, g12 * (v2 + v2)), fma(g22 * v2, v2, g2))
        value = root(larger(squared + cv + cv, zero)) + hv
        better = less(there, value)
        there, x1, x2 = blend(better, value, there), blend(better, v1, x1), blend(better, v2, x2)
        value = root(larger(squared - cv - cv, zero)) - hv
        better = less(back, value)
        back = blend(better, value, back)
        y1, y2 = blend(better, zero - v1, y1), blend(better, zero - v2, y2)
    best = larger(there, back)
    for _ in range(2):
        for _ in range(_CIRCLE_STEPS):
            # Newton's step of the angle; uphill by a set angle where F is convex.
            w1, w2 = fma(g11, x1, g12 * x2), fma(g12, x1, g22 * x2)
            hv, hw = fma(h1, x1, h2 * x2), h2 * x1 - h1 * x2
            along, across = fma(c1 + w1, x1, (c2 + w2) * x2), (c2 + w2) * x1 - (c1 + w1) * x2
            cv, vw = fma(c1, x1, c2 * x2), fma(w1, x1, w2 * x2)
            lam = root(larger(g2 + along + cv, tiny))
            inverse = one / lam
            slope = fma(across, inverse, hw)
            curve = (g11 + g22 - vw - along - across * across * inverse * inverse) * inverse - hv
            step = slope / larger(zero - curve, tiny)
            most = every(_LONGEST_TURN)
            step = smaller(larger(step, zero - most), most)
            z1, z2 = x1 - step * x2, fma(step, x1, x2)
            scale = one / root(fma(z1, z1, z2 * z2))
            x1, x2 = z1 * scale, z2 * scale
        hv, cv = fma(h1, x1, h2 * x2), fma(c1, x1, c2 * x2)
        squared = fma(x1, fma(g11, x1, g12 * (x2 + x2)), fma(g22 * x2, x2, g2))
        best = larger(best, root(larger(squared + cv + cv, zero)) + hv)
        x1, x2 = y1, y2
    return best


@compiled
def _finish(
    work: Array32,
    waiting: int,
    best: int,
    dots: int,
    free: int,
    m: int,
    options: Options,
    places: Integers,
    count: int,
    out: Array32,
) -> int:
    """Solve the gathered problems and write their distances."""
    size = (m + _PAD) * LANES
    start, other = free, free + size
    _start(work, waiting, start, other, m, 2 * _POWERS)
    for k in range(m):
        store(work, other + k * LANES, every(np.float32(0)) - load(work, start + k * LANES))
    gain = load(work, best)
    value, _, _ = _ascend(work, waiting, other + size, start, m, options.steps, True)
    gain = larger(gain, value)
    value, _, _ = _ascend(work, waiting, other + size, other, m, options.steps, True)
    gain = larger(gain, value)
    store(work, best, _distance(load(work, dots) + gain))
    inexact = 0
    for lane in range(count):
        distance = work[best + lane]
        if not distance > options.least:
            distance = np.float32(-1)
            inexact += 1
        out[places[lane]] = distance
    return inexact


@inlined
def _distance(similarity: Lanes) -> Lanes:
    two = every(np.float32(2))
    return root(larger(fma(every(np.float32(-2)), similarity, two), every(np.float32(0))))


@compiled
def spherical_subspaces(tile: Tile, options: Options, work: Array32, out: Result) -> int:
    """Distances between the parts of two subspaces that lie on the unit sphere.

    Parameters
    ----------
    tile
        Of the rows p and s D of the probes, q and t E of the templates.
    work : float32
        Of ``scratch_size(m_d, m_e)`` numbers, zeros.

    Returns
    -------
    int
        Number of −1, or of groups with one: distances that are not above the least.
    """
    product, columns, m_d, m_e = tile.product, len(tile.template_squares), tile.m_d, tile.m_e
    swapped = m_e > m_d
    high, low = (m_e, m_d) if swapped else (m_d, m_e)
    wide = low + _PAD
    size = (low + 2) * wide * LANES
    problem = high * wide * LANES
    waiting = problem + size
    best = waiting + size
    dots = best + LANES
    free = dots + 2 * LANES
    across, down = columns, (m_e + 1) * columns
    if swapped:
        across, down = down, across
    places = np.zeros(LANES, dtype=np.int64)
    filled = inexact = 0
    zero = every(np.float32(0))
    for i in range(len(tile.probe_terms)):
        for j in range(0, columns, LANES):
            origin = i * (m_d + 1) * (m_e + 1) * columns + j
            of_h = problem + (low + 1) * wide * LANES
            for e in range(low):
                store(work, of_h + e * LANES, load(product, origin + (e + 1) * across))
            for a in range(high):
                for e in range(low):
                    x = load(product, origin + (a + 1) * down + (e + 1) * across)
                    store(work, (a * wide + e) * LANES, x)
                store(work, (a * wide + low) * LANES, load(product, origin + (a + 1) * down))
            for k in range(low + 1):
                for r in range(k, low + 1, _PAD):
                    sums = zero, zero, zero, zero
                    for a in range(high):
                        x = load(work, (a * wide + k) * LANES)
                        sums = fma4(work, (a * wide + r) * LANES, LANES, x, sums)
                    store4(work, problem + (k * wide + r) * LANES, LANES, sums)
                for r in range(k + 1, low + 1):
                    x = load(work, problem + (k * wide + r) * LANES)
                    store(work, problem + (r * wide + k) * LANES, x)
            if low == 1:
                gain, proven = _of_one(work, problem), ALL
            elif low == 2:
                gain, proven = _of_two(work, problem), ALL
            else:
                gain, proven = _prove(work, problem, free, low, options.steps)
            dot = load(product, origin)
            distance = _distance(dot + gain)
            known = less(every(options.least), distance)
            place = i * out.stride + j
            distance = blend(known, distance, every(np.float32(-1)))
            put(out.distances, place, out.width - j, distance)
            inexact += known != ALL
            if proven == ALL:
                continue
            store(work, free, gain)
            store(work, free + LANES, dot)
            for lane in range(LANES):
                if proven >> lane & 1 or j + lane >= out.width:
                    continue
                for k in range(0, size, LANES):
                    work[waiting + k + filled] = work[problem + k + lane]
                work[best + filled] = work[free + lane]
                work[dots + filled] = work[free + LANES + lane]
                places[filled] = place + lane
                filled += 1
                if filled == LANES:
                    inexact += _finish(
                        work, waiting, best, dots, free, low, options, places, filled, out.distances
                    )
                    filled = 0
                    store(work, free, gain)
                    store(work, free + LANES, dot)
    if filled:
        inexact += _finish(
            work, waiting, best, dots, free, low, options, places, filled, out.distances
        )
    return inexact
