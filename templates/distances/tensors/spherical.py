"""Spherical distances on tensors (docs/method.md §3.5); ``templates.distances.spherical`` is the reference.

The similarity of two subspaces is p·q plus the maximum of g·u + h·v + uᵀBv over unit u and v. The
best u of a v is known, so with G = BᵀB and c = Bᵀg the objective is F(v) = h·v + λ with
λ² = ‖g‖² + 2 c·v + vᵀGv, and a step of the alternation is v ← normalise(h + (c + Gv)/λ).

A few steps from one start are followed by Newton's method on the Lagrangian dual, whose value
bounds the maximum from above: most pairs end with a proof that nothing better exists. The others
go through the reference's accelerated alternation from its two starts.
"""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from templates.distances.spherical import NEAR
from templates.distances.tensors.subspaces import (
    SubspaceTensors,
    blocks,
    chunks,
    fused,
    products,
    stacked,
)

PLAIN_STEPS = 8
NEWTON_STEPS = 8
GAP = 2e-6
"""A value this close to the upper bound is the maximum."""
LEAST_PIVOT = 3e-6
"""Of S, relative to μ; with a smaller one it does not count as positive definite."""
TINY = torch.finfo(torch.float32).tiny

# As in the reference: a pair rests when a step moves v by less, longer extrapolations are noise.
STILL = {torch.float32: 3e-5, torch.float64: 1e-10}
LONGEST = 1e3


def points(probes: Tensor, templates: SubspaceTensors) -> Tensor:
    """Distances of the directions of points (P, n) to templates, shape (P, T)."""
    directions = _normalised(probes.double()).float()
    matrix = directions @ stacked(*_on_sphere(templates)).T
    gram = matrix.view(len(probes), templates.m + 1, len(templates))
    similarities = torch.linalg.vector_norm(gram[:, 1:], dim=1).add_(gram[:, 0])
    distances = _distances(similarities)
    i, j = torch.nonzero(~(distances >= NEAR), as_tuple=True)
    if len(i):
        distances[i, j] = points_exact(probes, templates, i, j).float()
    return distances


def points_exact(probes: Tensor, templates: SubspaceTensors, i: Tensor, j: Tensor) -> Tensor:
    """Distances of points ``i`` to templates ``j`` from differences in float64, shape (K,)."""
    out = torch.empty(len(i), dtype=torch.float64, device=i.device)
    for part in chunks(len(i), 2 * templates.m * templates.n, i.device):
        theirs = templates[j[part]]
        scales, radii = _spheres(theirs.feet)
        bases = theirs.bases.double()
        directions = _normalised(probes[i[part]].double())
        inside = (bases.mT @ (bases @ directions[:, :, None]))[:, :, 0]
        nearest = theirs.feet * scales[:, None] + radii[:, None] * _normalised(inside)
        gaps = torch.linalg.vector_norm(directions - nearest, dim=1)
        # A zero probe has no direction: similarity 0 with everything.
        out[part] = gaps.masked_fill(~directions.any(dim=1), 2**0.5)
    return out


def subspaces(probes: SubspaceTensors, templates: SubspaceTensors, steps: int) -> Tensor:
    """Distances of all probes to all templates, shape (P, T); the probes' m is the larger one."""
    gram = products(_on_sphere(probes), _on_sphere(templates))
    turns = NEWTON_STEPS if steps > PLAIN_STEPS else 0
    plain = min(steps, PLAIN_STEPS)
    kernels = fused(probes.device, templates.m)
    if kernels is None:
        gains, v, proven = prove(_Problem.of(blocks(gram)), plain, turns)
    else:
        gains, v, proven = kernels.prove(gram, plain, turns)
    left = torch.nonzero(~proven)[:, 0]
    if kernels is None:
        found, best = maximise(gram, left, steps)
    else:
        found, best = kernels.maximise(gram, left, steps)
    better = found > gains[left]
    left = left[better]
    gains[left], v[left] = found[better], best[better]
    distances = _distances(gram[0, :, 0] + gains.view(len(probes), -1))
    i, j = torch.nonzero(~(distances >= NEAR), as_tuple=True)
    if len(i):
        v = v[i * len(templates) + j]
        distances[i, j] = _near(probes, templates, i, j, v, steps).float()
    return distances


class _Problem(NamedTuple):
    """Maximise g·u + h·v + uᵀBv over unit u and v, for K pairs."""

    g: Tensor
    """Shape (K, m_D)."""
    h: Tensor
    """Shape (K, m_E)."""
    b: Tensor
    """Shape (K, m_D, m_E)."""

    @classmethod
    def of(cls, block: Tensor) -> Self:
        """Take the parts of the products of [p; s D] and [q; t E], (K, m_D + 1, m_E + 1)."""
        return cls(block[:, 1:, 0], block[:, 0, 1:], block[:, 1:, 1:].contiguous())

    def take(self, index: Tensor) -> Self:
        return type(self)(*(part[index] for part in self))


def prove(problem: _Problem, plain: int, turns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Alternate, then improve the multipliers of |u| = 1 and |v| = 1 by Newton's method.

    Parameters
    ----------
    problem : of K pairs, float32
    plain : int
        Number of points of the alternation that are looked at, at least 1.
    turns : int
        Steps of Newton's method, at most. Without any, nothing is proven.

    Returns
    -------
    values : Tensor of float32, shape (K,)
        The objective at a v of unit length: never above the maximum.
    v : Tensor of float32, shape (K, m_E)
    proven : Tensor of bool, shape (K,)
        Where the value is within ``GAP`` of an upper bound of the maximum.

    Notes
    -----
    For S = μI − G/λ positive definite, with v = S⁻¹(h + c/λ) and u = (g + Bv)/λ, the bound is
    (λ + μ + g·u + h·v)/2. Its minimum has |u| = |v| = 1; Newton's step is on 1/|u| = 1/|v| = 1
    (Hebden 1973, Moré and Sorensen 1983). Where S is not positive definite, the step is halved
    back to the last multipliers that were feasible, or the first ones grow by a tenth.
    """
    g, h, b = problem
    gram, c, g2 = b.mT @ b, _times(b.mT, g), _dot(g, g)
    v = _normalised(h + c / g2.sqrt().clamp(min=TINY)[:, None])
    for taken in range(plain):
        along = c + _times(gram, v)
        lam = (g2 + _dot(v, c + along)).clamp(min=TINY).sqrt()
        following = h + along / lam[:, None]
        if taken < plain - 1:
            v = _normalised(following)
    mu = torch.linalg.vector_norm(following, dim=1).clamp(min=TINY)
    best, value = v.clone(), _dot(h, v) + lam
    proven = torch.zeros(len(v), dtype=torch.bool, device=v.device)
    last_lam, last_mu, seen = lam, mu, proven
    open_ = torch.arange(len(v), device=v.device)
    for _ in range(turns):
        system = torch.diag_embed(mu[:, None].expand_as(h)) - gram / lam[:, None, None]
        factor, failed = torch.linalg.cholesky_ex(system)
        pivots = factor.diagonal(dim1=1, dim2=2).square().amin(dim=1)
        sound = (failed == 0) & (pivots > LEAST_PIVOT * mu)
        v = torch.cholesky_solve((h + c / lam[:, None])[:, :, None], factor)[:, :, 0]
        along = c + _times(gram, v)
        u2 = (g2 + _dot(v, c + along)) / lam**2
        v2 = _dot(v, v)
        bound = (lam + mu + (g2 + _dot(c, v)) / lam + _dot(h, v)) / 2
        unit = v / v2.sqrt().clamp(min=TINY)[:, None]
        found = _dot(h, unit) + (g2 + _dot(unit, 2 * c + _times(gram, unit))).clamp(min=0).sqrt()
        better = sound & (found > value)
        value = torch.where(better, found, value)
        best[open_] = torch.where(better[:, None], unit, best[open_])
        done = sound & (bound - value < GAP)
        proven[open_[done]] = True

        sides = torch.stack([along / lam[:, None] ** 2, v], dim=2)
        solved = torch.cholesky_solve(sides, factor)
        uu = (u2 + _dot(along, solved[:, :, 0]) / lam) / lam
        uv, vv = _dot(v, solved[:, :, 0]), _dot(v, solved[:, :, 1])
        # The rows of the Jacobian of (1/|u|, 1/|v|) are multiplied by |u|³ and |v|³.
        of_u, of_v = u2 - u2 * u2.sqrt(), v2 - v2 * v2.sqrt()
        determinant = uu * vv - uv * uv
        next_lam = torch.maximum(lam - (vv * of_u - uv * of_v) / determinant, 0.3 * lam)
        next_mu = torch.maximum(mu - (uu * of_v - uv * of_u) / determinant, 0.3 * mu)
        back_lam = torch.where(seen, (lam + last_lam) / 2, 1.1 * lam)
        back_mu = torch.where(seen, (mu + last_mu) / 2, 1.1 * mu)
        state = (
            *(gram, c, g2, h, value, seen | sound, open_),
            *(torch.where(sound, lam, last_lam), torch.where(sound, mu, last_mu)),
            *(torch.where(sound, next_lam, back_lam), torch.where(sound, next_mu, back_mu)),
        )
        gram, c, g2, h, value, seen, open_, last_lam, last_mu, lam, mu = (
            part[~done] for part in state
        )
    # λ² cancels where Bv is near −g, so the value returned is that of an explicit u.
    lengths = torch.linalg.vector_norm(g + _times(b, best), dim=1)
    return _dot(problem.h, best) + lengths, best, proven


def maximise(gram: Tensor, pairs: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Accelerated alternation of some pairs from the reference's two starts.

    Parameters
    ----------
    gram : Tensor of float32, shape (m_D + 1, P, m_E + 1, T)
    pairs : Tensor of int64, shape (K,)
        Numbers i · T + j.
    steps : int

    Returns
    -------
    values : Tensor of float32, shape (K,)
    v : Tensor of float32, shape (K, m_E)
    """
    high, _, wide, templates = gram.shape
    values, v = gram.new_empty(len(pairs)), gram.new_empty(len(pairs), wide - 1)
    for part in chunks(len(pairs), (high + 8) * (wide + 8), pairs.device):
        rows, columns = pairs[part] // templates, pairs[part] % templates
        problem = _Problem.of(gram[:, rows, :, columns])
        values[part], v[part] = _maximise(problem, _starts(problem), steps)
    return values, v


def _starts(problem: _Problem) -> Tensor:
    """Starts of v, shape (K, 2, m_E): the leading right singular vector of B with both signs."""
    power = problem.b.mT @ problem.b
    tiny = torch.finfo(power.dtype).tiny
    for _ in range(5):
        diagonal = power.diagonal(dim1=1, dim2=2)
        power = power / diagonal.sum(dim=1).clamp(min=tiny)[:, None, None]
        power = power @ power
    largest = power.diagonal(dim1=1, dim2=2).argmax(dim=1)
    leading = _normalised(power[torch.arange(len(power), device=power.device), :, largest])
    return torch.stack([leading, -leading], dim=1)


def _maximise(problem: _Problem, starts: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Best value over all starts, shape (K,), and its v, shape (K, m_E).

    ``templates.distances.spherical._maximise``: extrapolated steps, a plain one where the value would fall.
    """
    count, tiny = len(starts), torch.finfo(starts.dtype).tiny
    values, best = starts.new_zeros(starts.shape[:2]), starts.clone()
    active = torch.arange(count, device=starts.device)
    v = starts
    value, stepped = _step(problem, v)
    moved = stepped - v
    trial = stepped
    for taken in range(1, steps):
        next_value, next_stepped = _step(problem, trial)
        if taken > 1:
            again = torch.nonzero((next_value < value).any(dim=1))[:, 0]
            keep = (next_value[again] >= value[again])[:, :, None]
            trial[again] = torch.where(keep, trial[again], stepped[again])
            next_value[again], next_stepped[again] = _step(problem.take(again), trial[again])
        next_moved = next_stepped - trial
        turn = next_moved - moved
        slope = _dot(next_moved, turn) / _dot(turn, turn).clamp(min=tiny)
        slope = slope.clamp(-LONGEST, LONGEST)[:, :, None]
        v, value, moved = trial, next_value, next_moved
        trial = _normalised(next_stepped - slope * (next_stepped - stepped))
        stepped = next_stepped
        if taken % 4 == 0:
            done = (_dot(moved, moved) < STILL[starts.dtype] ** 2).all(dim=1)
            values[active[done]], best[active[done]] = value[done], v[done]
            left = torch.nonzero(~done)[:, 0]
            active, problem = active[left], problem.take(left)
            v, value, moved, trial, stepped = (
                part[left] for part in (v, value, moved, trial, stepped)
            )
            if not len(left):
                break
    values[active], best[active] = value, v
    winner = values.argmax(dim=1)
    every = torch.arange(count, device=starts.device)
    return values[every, winner], best[every, winner]


def _step(problem: _Problem, v: Tensor) -> tuple[Tensor, Tensor]:
    """Value at v with the best u, shape (K, S), and the next v, shape (K, S, m_E)."""
    u = v @ problem.b.mT + problem.g[:, None, :]
    norms = torch.linalg.vector_norm(u, dim=2)
    u = u / norms.clamp(min=torch.finfo(u.dtype).tiny)[:, :, None]
    following = u @ problem.b + problem.h[:, None, :]
    return norms + _times(v, problem.h), _normalised(following)


def _near(
    probes: SubspaceTensors,
    templates: SubspaceTensors,
    i: Tensor,
    j: Tensor,
    v: Tensor,
    steps: int,
) -> Tensor:
    """Distances of close pairs: iterate on in float64 and subtract the closest points."""
    out = torch.empty(len(i), dtype=torch.float64, device=i.device)
    for part in chunks(len(i), 2 * (probes.m + templates.m) * probes.n, i.device):
        mine, theirs = probes[i[part]], templates[j[part]]
        p, d = _on_sphere(mine, torch.float64)
        q, e = _on_sphere(theirs, torch.float64)
        problem = _Problem(_times(d, q), _times(e, p), d @ e.mT)
        starts = torch.cat([v[part, None].double(), _starts(problem)], dim=1)
        _, best = _maximise(problem, starts, steps)
        u = _normalised(problem.g + _times(problem.b, best))
        best = _normalised(problem.h + _times(problem.b.mT, u))
        x = p + _spheres(mine.feet)[1][:, None] * _normalised(_times(mine.bases.double().mT, u))
        y = q + _spheres(theirs.feet)[1][:, None] * _normalised(
            _times(theirs.bases.double().mT, best)
        )
        out[part] = torch.linalg.vector_norm(x - y, dim=1)
    return out


def _spheres(feet: Tensor) -> tuple[Tensor, Tensor]:
    """Factors of the foot points and radii of the intersections with the sphere, float64, (N,).

    A set that misses the sphere is replaced by its foot point's direction.
    """
    norms = torch.linalg.vector_norm(feet, dim=1, dtype=torch.float64)
    return 1 / norms.clamp(min=1), (1 - norms.square()).clamp(min=0).sqrt()


def _on_sphere(batch: SubspaceTensors, dtype: torch.dtype = torch.float32) -> tuple[Tensor, Tensor]:
    """Feet and bases times their factors, so that products need none."""
    scales, radii = (part.to(dtype) for part in _spheres(batch.feet))
    return batch.feet.to(dtype) * scales[:, None], batch.bases.to(dtype) * radii[:, None, None]


def _distances(similarities: Tensor) -> Tensor:
    return (2 - 2 * similarities).clamp_(min=0).sqrt_()


def _normalised(rows: Tensor) -> Tensor:
    """Unit rows along the last axis; a zero row stays zero."""
    norms: Tensor = torch.linalg.vector_norm(rows, dim=-1, keepdim=True)
    return rows / norms.clamp(min=torch.finfo(rows.dtype).tiny)


def _dot(x: Tensor, y: Tensor) -> Tensor:
    return (x * y).sum(dim=-1)


def _times(matrix: Tensor, x: Tensor) -> Tensor:
    return (matrix @ x[..., None])[..., 0]
