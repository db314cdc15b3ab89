"""Synthetic people: descriptors that cluster by person, and contracts calibrated on them."""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Binding
from templates.decoys import DecoyGenerator, DecoyPool
from templates.keys.rotation import ROTATION_VERSION, TenantRotation
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch
from verify import Calibrated, CalibrationOptions, calibrate

N = 64
K = 60
"""Axes that embeddings are projected on."""
M = 6
LIFT_SECRET = bytes(range(32))


@dataclass(frozen=True, eq=False)
class People:
    """Unit descriptors (K, n), and K names."""

    descriptors: NDArray[np.float32]
    names: list[str]


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(rows / np.linalg.norm(rows, axis=-1, keepdims=True), dtype=np.float32)


def draw_people(
    count: int,
    *,
    photos: tuple[int, ...] = (4, 1, 3),
    n: int = N,
    noise: float = 0.5,
    seed: int = 0,
) -> People:
    """Draw ``count`` people; person i has ``photos[i % len(photos)]`` photos."""
    rng = np.random.default_rng(seed)
    owner = np.repeat(np.arange(count), [photos[i % len(photos)] for i in range(count)])
    centres = unit(rng.normal(size=(count, n)))
    rows = unit(centres[owner] + noise * unit(rng.normal(size=(len(owner), n))))
    return People(rows, [f"person-{seed}-{i:04d}" for i in owner])


@functools.cache
def make_generator(n: int = N, k: int = K) -> DecoyGenerator:
    people = draw_people(400, photos=(1,), n=n, seed=101)
    return DecoyGenerator.fit(people.descriptors).reduced(min(n, k))


def make_pool(n: int = N) -> DecoyPool:
    return DecoyPool(draw_people(400, photos=(1,), n=n, seed=101).descriptors)


def make_binding(
    source_id: str, *, strategy: Strategy = Strategy.ADVERSARIAL, m: int = M, axes: int = K
) -> Binding:
    return Binding(
        embedder_sha256="ab" * 32,
        preprocessing={"size": 112, "mean": [127.5, 127.5, 127.5], "flip": False},
        n=N,
        axes=axes,
        strategy=strategy,
        m=m,
        decoy_source_id=source_id,
        rotation_version=ROTATION_VERSION,
    )


def calibrate_people(
    people: People,
    *,
    options: CalibrationOptions | None = None,
    strategy: Strategy = Strategy.ADVERSARIAL,
) -> Calibrated:
    source = make_generator()
    return calibrate(
        people.descriptors,
        people.names,
        binding=make_binding(source.source_id, strategy=strategy),
        source=source,
        options=options
        or CalibrationOptions(
            probe_dims=(0, 2),
            probe_photos=(1,),
            lifted_probes=300,
            lifted_impostor_pairs=30_000,
            steps=20,
        ),
    )


def tenant_rotation(n: int = K, seed: int = 5) -> TenantRotation:
    """Gives the templates of one tenant their rotations."""
    return TenantRotation(seed.to_bytes(32), n)


def embeddings_of(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Embeddings (P, n) whose coordinates along the axes of :func:`make_generator` are given."""
    return np.asarray(points @ make_generator().axes.T, dtype=np.float32)


def projected(descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
    """Coordinates (K,) of one embedding."""
    return make_generator().project(descriptor[None])[0]


def spherical(probe: NDArray[np.floating], template: SubspaceBatch) -> float:
    """Similarity of docs/method.md §3.4 in float64: e·p + s‖D e‖."""
    e, p, d = (part.astype(np.float64) for part in (probe, template.foot, template.basis))
    return float(e @ p + np.sqrt(1 - p @ p) * np.linalg.norm(d @ e))
