"""A population of nobody whose descriptors are spread as faces' are: few long axes, many short."""

import functools

import numpy as np
from numpy.typing import NDArray

from templates.contract.document import Binding, Contract
from templates.decoys import DecoyGenerator
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy, lift
from templates.space.subspace import SubspaceBatch
from tests.verify.synthetic import unit
from verify import CalibrationOptions, calibrate

N, K, M = 64, 56, 8
PHOTOS = 3
PEOPLE = 400
Floats = NDArray[np.float32]


def photos_of(people: int, photos: int, *, seed: int) -> Floats:
    """(people, photos, N) unit descriptors; another seed is other people."""
    rng = np.random.default_rng([11, seed])
    axes = np.linalg.qr(np.random.default_rng(11).normal(size=(N, N)))[0]
    deviations = np.arange(1, N + 1) ** -0.5
    middle = 1.2 * axes[3] + 0.5 * axes[40]
    persons = middle + (rng.normal(size=(people, 1, N)) * deviations) @ axes
    return unit(persons + 0.35 * (rng.normal(size=(people, photos, N)) * deviations) @ axes)


def enrolled(people: int, *, seed: int) -> Floats:
    """Means of the photos of people, as they are enrolled, (people, N)."""
    return unit(photos_of(people, PHOTOS, seed=seed).mean(axis=1))


@functools.cache
def decoys() -> DecoyGenerator:
    return DecoyGenerator.fit(photos_of(800, 1, seed=1)[:, 0]).reduced(K)


def templates_of(descriptors: Floats, *, seed: int) -> SubspaceBatch:
    points = decoys().project(descriptors)
    stream = Keystream.seeded("population", seed)
    return lift(points, strategy=Strategy.ADVERSARIAL, m=M, source=decoys(), stream=stream)


@functools.cache
def contract() -> Contract:
    """A contract, calibrated as `veilface calibrate` does; its secret is a constant."""
    return calibrate(
        photos_of(PEOPLE, PHOTOS + 1, seed=2).reshape(-1, N),
        [f"p{i}" for i in range(PEOPLE) for _ in range(PHOTOS + 1)],
        binding=Binding(
            embedder_sha256="ab" * 32,
            preprocessing={"size": 112},
            n=N,
            axes=K,
            strategy=Strategy.ADVERSARIAL,
            m=M,
            decoy_source_id=decoys().source_id,
            rotation_version=ROTATION_VERSION,
        ),
        source=decoys(),
        cohort_seed=bytes(range(32)),
        options=CalibrationOptions(targets=(1e-2, 1e-3), most_cells=100_000),
    ).contract


def wolf() -> SubspaceBatch:
    """The leading axes of faces, with a foot point along their mean, as honest templates have."""
    mean = decoys().mean.astype(np.float64)
    axes = np.eye(K)[:M]
    foot = mean - axes.T @ (axes @ mean)
    low, high = contract().template_foot_point_norm
    foot *= (low + high) / 2 / np.linalg.norm(foot)
    return SubspaceBatch(foot.astype(np.float32), axes.astype(np.float32))
