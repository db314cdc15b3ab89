"""People and decoys whose kinds are told by their deviations along the axes."""

import functools

import numpy as np

from templates.decoys import DecoyGenerator
from tests.verify.synthetic import unit

N = 48
FACES = np.linspace(1.0, 0.3, N)
OTHER = np.roll(FACES, N // 2)


def rows(count: int, deviations: np.ndarray, seed: int) -> np.ndarray:
    return unit(np.random.default_rng(seed).normal(size=(count, N)) * deviations).astype(np.float32)


@functools.cache
def generator(kind: tuple[float, ...]) -> DecoyGenerator:
    return DecoyGenerator.fit(rows(3_000, np.array(kind), 4))
