"""Probes and templates that the tests of distances share, and the three that compute them."""

from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import scipy.linalg

from templates.distances import Metric, Neighbours, exact
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch

N = 24
METRICS = [str(metric) for metric in Metric]
BACKENDS = ["exact", "compiled", "torch"]

Matrix = Callable[..., np.ndarray]


def backend(name: str) -> tuple[ModuleType, dict[str, Any]]:
    """What computes, and the options that it alone has; the test is skipped where it is missing."""
    if name == "exact":
        return exact, {}
    if name == "compiled":
        pytest.importorskip("numba", reason="numba is of the extra evaluate")
        from templates.distances import compiled

        return compiled, {}
    pytest.importorskip("torch", reason="torch is an optional extra")
    from templates.distances import torch

    return torch, {"device": "cpu"}


def matrix(
    name: str,
    probes: Any,
    templates: SubspaceBatch,
    *,
    metric: str,
    steps: int = 50,
    **options: Any,
) -> np.ndarray:
    """All distances, put together from the parts that a backend yields."""
    module, own = backend(name)
    dtype = np.float64 if name == "exact" else np.float32
    if isinstance(probes, np.ndarray):
        probes = probes.astype(dtype)
    out = np.full((len(probes), len(templates)), np.nan, dtype=dtype)
    seen = np.zeros(out.shape, dtype=int)
    options = own | options | {"metric": Metric(metric), "steps": steps}
    for rows, columns, distances in module.tiles(probes, templates, **options):
        assert distances.dtype == dtype
        out[rows, columns] = distances
        seen[rows, columns] += 1
    assert (seen == 1).all()
    return out


def units(stream: Keystream, count: int, n: int = N) -> np.ndarray:
    rows = stream.normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def through(members: np.ndarray, seed: int = 0) -> SubspaceBatch:
    """The set that holds all members."""
    return SubspaceBatch.through(
        members[0], members[1:] - members[0], stream=Keystream.seeded("through", seed)
    )


def randoms(count: int, m: int, seed: int, n: int = N) -> SubspaceBatch:
    stream = Keystream.seeded("randoms", seed)
    return lift(units(stream, count, n), strategy="random", m=m, stream=stream)


def face_like(stream: Keystream, count: int, n: int) -> np.ndarray:
    """Unit rows that are spread like faces: a mean, a steep spectrum."""
    scales = 1 / np.sqrt(1 + np.arange(n) / 8)
    rows = stream.normal((count, n)) * scales + 0.3 * (np.arange(n) == 0)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def faces(count: int, m: int, seed: int, n: int = 128) -> SubspaceBatch:
    """Sets through m + 1 rows that are spread like faces."""
    stream = Keystream.seeded("faces", seed)
    members = face_like(stream, count * (m + 1), n).reshape(count, m + 1, n)
    return SubspaceBatch.through(members[:, 0], members[:, 1:] - members[:, :1], stream=stream)


def pairs() -> dict[str, tuple[SubspaceBatch, SubspaceBatch]]:
    """Pairs of subspaces in every relation that matters."""
    stream = Keystream.seeded("pairs")
    x = units(stream, 14)
    axes = scipy.linalg.qr(stream.normal((N, N)))[0]
    of = SubspaceBatch
    tilt = np.cos(1e-3) * axes[0] + np.sin(1e-3) * axes[1]
    crossing = 0.5 * axes[9] + 0.3 * (np.cos(0.01) * axes[1] - np.sin(0.01) * axes[0])
    crossed = np.cos(0.01) * axes[0] + np.sin(0.01) * axes[1]
    plane = np.stack([axes[0], axes[1], axes[2]])
    slight = np.cos(2e-5) * axes[0] + np.sin(2e-5) * axes[1]
    return {
        "random": (through(x[:4]), through(x[4:8])),
        "unequal dimensions": (through(x[:3]), through(x[4:10])),
        "lines": (through(x[:2]), through(x[2:4])),
        "shared decoy": (through(x[:4]), through(x[3:7])),
        "two shared decoys": (through(x[:5]), through(x[3:8])),
        "contained": (through(x[:6]), through(x[1:4])),
        "identical": (through(x[:4]), through(x[:4], seed=1)),
        "orthogonal": (of(0.4 * axes[8], axes[:3]), of(0.5 * axes[9], axes[3:6])),
        "parallel": (of(0.4 * axes[8], axes[:3]), of(0.5 * axes[9], axes[:3])),
        "parallel, other basis": tuple(
            SubspaceBatch.through(foot, plane, stream=Keystream.seeded("plane", seed))
            for seed, foot in enumerate((0.4 * axes[8], 0.5 * axes[9]))
        ),
        # The closest points are 30 away from the foot points: float32 products do not do.
        "crossing far away": (of(0.4 * axes[8], axes[:1]), of(crossing, crossed[None])),
        "one shared direction": (of(0.4 * axes[8], axes[:3]), of(0.5 * axes[9], axes[2:5])),
        "nearly parallel": (of(0.4 * axes[8], axes[:1]), of(0.5 * axes[9], tilt[None])),
        "very nearly parallel": (
            of(0.4 * axes[8], axes[[0, 4]]),
            of(0.5 * axes[9], np.stack([slight, axes[5]])),
        ),
        "central": (of(np.zeros(N), axes[:3]), through(x[:4])),
        "close": (of(0.4 * axes[8], axes[:2]), of(0.4 * axes[8] + 0.02 * axes[9], axes[2:4])),
    }


def sorted_matrix(distances: np.ndarray, k: int) -> Neighbours:
    """What the K nearest are by a stable sort of all distances."""
    distances = np.pad(distances, ((0, 0), (0, k)), constant_values=np.inf)
    order = np.argsort(distances, axis=1, kind="stable")[:, :k]
    nearest = np.take_along_axis(distances, order, axis=1)
    return Neighbours(np.where(np.isinf(nearest), -1, order), nearest)
