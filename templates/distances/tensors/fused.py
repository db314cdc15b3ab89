"""Triton kernels for the small systems of many pairs, a block of pairs in one program.

A program reads the products of its pairs component by component, neighbouring pairs from
neighbouring addresses, and keeps everything else in registers. Matrices are (M, M, BLOCK) with M
the next power of two: rows, columns, pairs.

The functions return what their namesakes of ``templates.distances.tensors.euclidean`` and ``.spherical`` do.
They have run in Triton's interpreter and been compiled for Hopper; no GPU has run them yet.
"""

# mypy: disable-error-code="no-untyped-def, untyped-decorator"
# Types of a kernel's arguments are Triton's, not Python's.

import contextlib

import torch
import triton
import triton.language as tl
from torch import Tensor

from templates.distances.tensors import euclidean, spherical

LARGEST = 16
"""Systems with more unknowns do not fit in the registers."""

# Else every odd tile at an edge would be compiled anew.
_INTEGERS = ["count", "probes", "templates", "m_d", "plain", "turns", "steps"]

_PRECISION = tl.constexpr(euclidean.PRECISION)
_SMALLEST_PIVOT = tl.constexpr(euclidean.SMALLEST_PIVOT)
_BULK_ERROR = tl.constexpr(euclidean.BULK_ERROR)
_LEAST_PIVOT = tl.constexpr(spherical.LEAST_PIVOT)
_GAP = tl.constexpr(spherical.GAP)
_STILL2 = tl.constexpr(spherical.STILL[torch.float32] ** 2)
_LONGEST = tl.constexpr(spherical.LONGEST)
_TINY = tl.constexpr(spherical.TINY)


@triton.jit
def _inverse(matrix, least, m: tl.constexpr, M: tl.constexpr):
    """Inverses of symmetric matrices (M, M, BLOCK), and where all pivots exceed ``least``.

    Sweeps (Goodnight 1979) with the m diagonal elements as pivots, which are those of a Cholesky
    factorisation.
    """
    item = tl.arange(0, M)[:, None]
    row = tl.arange(0, M)[:, None, None]
    column = tl.arange(0, M)[None, :, None]
    sound = least == least
    for k in tl.static_range(m):
        picked = tl.sum(tl.where(column == k, matrix, 0.0), axis=1)
        pivot = tl.sum(tl.where(item == k, picked, 0.0), axis=0)
        sound = sound & (pivot > least)
        inverse = 1.0 / tl.where(pivot > least, pivot, 1.0)
        scaled = picked * inverse[None, :]
        rest = matrix - picked[:, None, :] * scaled[None, :, :]
        crossing = tl.where(row == k, -inverse[None, None, :], scaled[:, None, :])
        matrix = tl.where(column == k, crossing, tl.where(row == k, scaled[None, :, :], rest))
    return -matrix, sound


@triton.jit
def _times(matrix, x):
    """Product of symmetric matrices (M, M, BLOCK) with vectors (M, BLOCK)."""
    return tl.sum(matrix * x[:, None, :], axis=0)


@triton.jit
def _dot(x, y):
    return tl.sum(x * y, axis=0)


@triton.jit
def _normalised(x):
    return x / tl.maximum(tl.sqrt(_dot(x, x)), _TINY)[None, :]


@triton.jit
def _own(count, BLOCK: tl.constexpr):
    """Numbers of the program's pairs, and which of them exist."""
    own = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return own, own < count


@triton.jit
def _place(pair, inside, probes, templates, m: tl.constexpr, M: tl.constexpr):
    """Where the products of pairs begin, with p·q; from one row of D to the next; E's rows."""
    item = tl.arange(0, M)[:, None]
    stride = (m + 1) * templates
    first = pair // templates * stride + pair % templates
    return first, stride * probes, (item + 1) * templates, (item < m) & inside[None, :]


@triton.jit
def _reduced(
    gram, first, stride, components, real, inside, m_d, M: tl.constexpr, BLOCK: tl.constexpr
):
    """G = BᵀB, c = Bᵀg, ‖g‖² and h."""
    square = tl.zeros((M, M, BLOCK), dtype=tl.float32)
    c = tl.zeros((M, BLOCK), dtype=tl.float32)
    g2 = tl.zeros((BLOCK,), dtype=tl.float32)
    h = tl.load(gram + first[None, :] + components, mask=real, other=0.0)
    for a in range(1, m_d + 1):
        start = first + a * stride
        g = tl.load(gram + start, mask=inside, other=0.0)
        b = tl.load(gram + start[None, :] + components, mask=real, other=0.0)
        square += b[:, None, :] * b[None, :, :]
        c += g[None, :] * b
        g2 += g * g
    return square, c, g2, h


@triton.jit
def _value(gram, first, stride, components, real, inside, m_d, v, BLOCK: tl.constexpr):
    """The objective at v with an explicit u: λ² from G cancels where Bv is near −g."""
    u2 = tl.zeros((BLOCK,), dtype=tl.float32)
    for a in range(1, m_d + 1):
        start = first + a * stride
        g = tl.load(gram + start, mask=inside, other=0.0)
        b = tl.load(gram + start[None, :] + components, mask=real, other=0.0)
        u = g + _dot(b, v)
        u2 += u * u
    return _dot(tl.load(gram + first[None, :] + components, mask=real, other=0.0), v) + tl.sqrt(u2)


@triton.jit
def _step(square, c, g2, h, v):
    """The objective at v, and the next v of the alternation."""
    along = c + _times(square, v)
    lam = tl.sqrt(tl.maximum(g2 + _dot(v, c + along), _TINY))
    return _dot(h, v) + lam, _normalised(h + along / lam[None, :])


@triton.jit
def _ascended(square, c, g2, h, v, inside, steps):
    """Value and v of the accelerated alternation, ``templates.distances.spherical.maximise``."""
    value, stepped = _step(square, c, g2, h, v)
    moved = stepped - v
    trial = stepped
    active = inside
    taken = 1
    left = tl.sum(active.to(tl.int32), axis=0)
    while left * (steps - taken) > 0:
        next_value, following = _step(square, c, g2, h, trial)
        worse = active & (next_value < value) & (taken > 1)
        if tl.sum(worse.to(tl.int32), axis=0) > 0:
            trial = tl.where(worse[None, :], stepped, trial)
            next_value, following = _step(square, c, g2, h, trial)
        motion = following - trial
        turn = motion - moved
        slope = _dot(motion, turn) / tl.maximum(_dot(turn, turn), _TINY)
        slope = tl.minimum(tl.maximum(slope, -_LONGEST), _LONGEST)
        value = tl.where(active, next_value, value)
        v = tl.where(active[None, :], trial, v)
        trial = _normalised(following - slope[None, :] * (following - stepped))
        stepped, moved = following, motion
        active = active & (_dot(motion, motion) >= _STILL2)
        left = tl.sum(active.to(tl.int32), axis=0)
        taken += 1
    return value, v


@triton.jit(do_not_specialize=_INTEGERS)
def _schur_kernel(
    gram,
    mine,
    theirs,
    out,
    count,
    probes,
    templates,
    m_d,
    m: tl.constexpr,
    M: tl.constexpr,
    BLOCK: tl.constexpr,
):
    pair, inside = _own(count, BLOCK)
    first, stride, components, real = _place(pair, inside, probes, templates, m, M)
    same = tl.arange(0, M)[:, None, None] == tl.arange(0, M)[None, :, None]
    normal = tl.where(same, 1.0, 0.0) + tl.zeros((M, M, BLOCK), dtype=tl.float32)
    w = -tl.load(gram + first[None, :] + components, mask=real, other=0.0)
    squared = tl.load(mine + pair // templates, mask=inside, other=0.0)
    squared += tl.load(theirs + pair % templates, mask=inside, other=0.0)
    squared -= 2.0 * tl.load(gram + first, mask=inside, other=0.0)
    for a in range(1, m_d + 1):
        start = first + a * stride
        left = tl.load(gram + start, mask=inside, other=0.0)
        middle = tl.load(gram + start[None, :] + components, mask=real, other=0.0)
        normal -= middle[:, None, :] * middle[None, :, :]
        w -= left[None, :] * middle
        squared -= left * left
    least = tl.full((BLOCK,), _SMALLEST_PIVOT, dtype=tl.float32)
    inverse, sound = _inverse(normal, least, m, M)
    # What the sweeps left where no pivot was belongs to no unknown, and w is 0 there.
    beta = _times(inverse, w)
    squared -= _dot(w, beta)
    sizes = 1.0 + 2.0 * _dot(beta, beta)
    sound = sound & (4.0 * _PRECISION * sizes < _BULK_ERROR * squared)
    tl.store(out + pair, tl.where(sound, squared, float("nan")), mask=inside)


@triton.jit(do_not_specialize=_INTEGERS)
def _prove_kernel(
    gram,
    values,
    vectors,
    proofs,
    count,
    probes,
    templates,
    m_d,
    plain,
    turns,
    m: tl.constexpr,
    M: tl.constexpr,
    BLOCK: tl.constexpr,
):
    pair, inside = _own(count, BLOCK)
    first, stride, components, real = _place(pair, inside, probes, templates, m, M)
    square, c, g2, h = _reduced(gram, first, stride, components, real, inside, m_d, M, BLOCK)
    same = tl.arange(0, M)[:, None, None] == tl.arange(0, M)[None, :, None]
    following = h + c / tl.maximum(tl.sqrt(g2), _TINY)[None, :]
    v = tl.zeros((M, BLOCK), dtype=tl.float32)
    lam = tl.zeros((BLOCK,), dtype=tl.float32)
    for _ in range(plain):
        v = _normalised(following)
        along = c + _times(square, v)
        lam = tl.sqrt(tl.maximum(g2 + _dot(v, c + along), _TINY))
        following = h + along / lam[None, :]
    mu = tl.maximum(tl.sqrt(_dot(following, following)), _TINY)
    best, value = v, _dot(h, v) + lam
    last_lam, last_mu = lam, mu
    seen = lam < 0.0
    proven = lam < 0.0
    left = tl.sum(inside.to(tl.int32), axis=0)
    taken = 0
    while left * (turns - taken) > 0:
        taken += 1
        system = tl.where(same, mu[None, None, :], 0.0) - square / lam[None, None, :]
        inverse, sound = _inverse(system, _LEAST_PIVOT * mu, m, M)
        v = _times(inverse, h + c / lam[None, :])
        along = c + _times(square, v)
        u2 = (g2 + _dot(v, c + along)) / (lam * lam)
        v2 = _dot(v, v)
        bound = 0.5 * (lam + mu + (g2 + _dot(c, v)) / lam + _dot(h, v))
        unit = v / tl.maximum(tl.sqrt(v2), _TINY)[None, :]
        found = g2 + _dot(unit, 2.0 * c + _times(square, unit))
        found = _dot(h, unit) + tl.sqrt(tl.maximum(found, 0.0))
        better = sound & (found > value) & (proven == 0)
        value = tl.where(better, found, value)
        best = tl.where(better[None, :], unit, best)
        proven = proven | (sound & (bound - value < _GAP))
        left = tl.sum((inside & (proven == 0)).to(tl.int32), axis=0)

        along_u = _times(inverse, along / (lam * lam)[None, :])
        along_v = _times(inverse, v)
        uu = (u2 + _dot(along, along_u) / lam) / lam
        uv, vv = _dot(v, along_u), _dot(v, along_v)
        of_u, of_v = u2 - u2 * tl.sqrt(u2), v2 - v2 * tl.sqrt(v2)
        determinant = uu * vv - uv * uv
        next_lam = tl.maximum(lam - (vv * of_u - uv * of_v) / determinant, 0.3 * lam)
        next_mu = tl.maximum(mu - (uu * of_v - uv * of_u) / determinant, 0.3 * mu)
        next_lam = tl.where(sound, next_lam, tl.where(seen, 0.5 * (lam + last_lam), 1.1 * lam))
        next_mu = tl.where(sound, next_mu, tl.where(seen, 0.5 * (mu + last_mu), 1.1 * mu))
        last_lam, last_mu = tl.where(sound, lam, last_lam), tl.where(sound, mu, last_mu)
        seen = seen | sound
        lam, mu = next_lam, next_mu

    value = _value(gram, first, stride, components, real, inside, m_d, best, BLOCK)
    item = tl.arange(0, M)[:, None]
    tl.store(values + pair, value, mask=inside)
    tl.store(vectors + pair[None, :] * m + item, best, mask=real)
    tl.store(proofs + pair, proven.to(tl.int8), mask=inside)


@triton.jit(do_not_specialize=_INTEGERS)
def _maximise_kernel(
    gram,
    pairs,
    values,
    vectors,
    count,
    probes,
    templates,
    m_d,
    steps,
    m: tl.constexpr,
    M: tl.constexpr,
    BLOCK: tl.constexpr,
):
    own, inside = _own(count, BLOCK)
    pair = tl.load(pairs + own, mask=inside, other=0)
    first, stride, components, real = _place(pair, inside, probes, templates, m, M)
    square, c, g2, h = _reduced(gram, first, stride, components, real, inside, m_d, M, BLOCK)
    column = tl.arange(0, M)[None, :, None]
    same = tl.arange(0, M)[:, None, None] == column
    # A column of a high power of G is its leading eigenvector.
    power = square
    for _ in range(5):
        trace = tl.sum(tl.sum(tl.where(same, power, 0.0), axis=0), axis=0)
        power = power / tl.maximum(trace, _TINY)[None, None, :]
        squared = tl.zeros((M, M, BLOCK), dtype=tl.float32)
        for k in tl.static_range(m):
            picked = tl.sum(tl.where(column == k, power, 0.0), axis=1)
            squared += picked[:, None, :] * picked[None, :, :]
        power = squared
    largest = tl.argmax(tl.sum(tl.where(same, power, 0.0), axis=1), axis=0)
    v = _normalised(tl.sum(tl.where(column == largest[None, None, :], power, 0.0), axis=1))
    value, best = _ascended(square, c, g2, h, v, inside, steps)
    other_value, other = _ascended(square, c, g2, h, -v, inside, steps)
    best = tl.where((other_value > value)[None, :], other, best)
    value = _value(gram, first, stride, components, real, inside, m_d, best, BLOCK)
    item = tl.arange(0, M)[:, None]
    tl.store(values + own, value, mask=inside)
    tl.store(vectors + own[None, :] * m + item, best, mask=real)


def schur(gram: Tensor, mine: Tensor, theirs: Tensor) -> Tensor:
    """Squared Euclidean distances, shape (P, T); NaN where they may be inexact.

    Parameters
    ----------
    gram : Tensor of float32, shape (m_D + 1, P, m_E + 1, T), contiguous
        Products of the rows [p; D] and [q; E], m_E <= 16.
    mine, theirs : Tensor of float32, shapes (P,) and (T,)
        ‖p‖² and ‖q‖².
    """
    _, probes, _, templates = gram.shape
    out = gram.new_empty(probes, templates)
    grid, sizes, options = _shape(gram)
    with _device(gram):
        _schur_kernel[grid](gram, mine, theirs, out, *sizes, **options)
    return out


def prove(gram: Tensor, plain: int, turns: int) -> tuple[Tensor, Tensor, Tensor]:
    """First stage of the spherical similarity, see ``templates.distances.tensors.spherical.prove``.

    Parameters
    ----------
    gram : Tensor of float32, shape (m_D + 1, P, m_E + 1, T), contiguous
        Products of the rows [p; s D] and [q; t E], m_E <= 16.
    plain, turns : int

    Returns
    -------
    values : Tensor of float32, shape (P · T,)
    v : Tensor of float32, shape (P · T, m_E)
    proven : Tensor of bool, shape (P · T,)
    """
    grid, sizes, options = _shape(gram)
    count, m = sizes[0], gram.shape[2] - 1
    values, vectors = gram.new_empty(count), gram.new_empty(count, m)
    proofs = torch.empty(count, dtype=torch.int8, device=gram.device)
    with _device(gram):
        _prove_kernel[grid](gram, values, vectors, proofs, *sizes, plain, turns, **options)
    return values, vectors, proofs.bool()


def maximise(gram: Tensor, pairs: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Second stage, for some pairs, see ``templates.distances.tensors.spherical.maximise``.

    ``gram`` as for `prove`.
    """
    count, m = len(pairs), gram.shape[2] - 1
    values, vectors = gram.new_empty(count), gram.new_empty(count, m)
    if count:
        grid, (_, *sizes), options = _shape(gram, count)
        with _device(gram):
            _maximise_kernel[grid](gram, pairs, values, vectors, count, *sizes, steps, **options)
    return values, vectors


def _shape(
    gram: Tensor, count: int | None = None
) -> tuple[tuple[int], tuple[int, int, int, int], dict[str, int]]:
    """Grid, sizes and compile-time constants of a launch for ``count`` pairs, or all."""
    high, probes, wide, templates = gram.shape
    m = wide - 1
    count = probes * templates if count is None else count
    padded = triton.next_power_of_2(m)
    # The largest blocks with which the assembler for Hopper spills at most a few registers.
    block, warps = (32, 1) if padded <= 8 else (16, 4)
    options = {"m": m, "M": padded, "BLOCK": block, "num_warps": warps, "enable_fp_fusion": True}
    return (triton.cdiv(count, block),), (count, probes, templates, high - 1), options


def _device(gram: Tensor) -> contextlib.AbstractContextManager[object]:
    """Make the tensor's GPU the current one, where Triton launches."""
    return torch.cuda.device(gram.device) if gram.is_cuda else contextlib.nullcontext()
