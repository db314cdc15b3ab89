"""Descriptors of nobody, spread like those of enrolled people: a contract's sealed strangers.

They serve twice. A template that a client sends is held against them: one that lies near strangers
on purpose, a *wolf*, lies near these too, whom its maker cannot know. And a subject that does not
exist is decided against a template that was lifted from one of them (``verify.stand_ins``).
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from templates.decoys.generator import DecoyGenerator
from templates.distances import Metric, pairwise_distances, similarity
from templates.errors import ContractError
from templates.keys.randomness import Keystream
from templates.space.embedding import UNIT_TOLERANCE
from templates.space.lifting import Strategy, draw_directions
from templates.space.subspace import AffineSubspace, SubspaceBatch, span_basis

SIZES = (2, 65_536)
TILT = 2.0
"""Weight of near strangers in :meth:`Nobody.score`: one 3 standard deviations above the cohort
counts e⁶ = 403 times as much as one at its mean, and an honest template's score still rests on
many of them."""


@dataclass(frozen=True, eq=False, repr=False)
class Nobody:
    """Strangers who do not exist, and what lifts templates of them.

    Parameters
    ----------
    people : (K, n) float32
        Unit rows. Secret, as the cohort is: who has them can make a wolf that they do not see.
    means, spreads : (K,) float32
        Mean and standard deviation of each one's similarities to the contract's cohort.
    generator
        Decoys of templates of nobody: those that lifting clients take.
    """

    people: NDArray[np.float32]
    means: NDArray[np.float32]
    spreads: NDArray[np.float32]
    generator: DecoyGenerator

    def __getitem__(self, rows: slice) -> "Nobody":
        """Some of the strangers."""
        return replace(
            self, people=self.people[rows], means=self.means[rows], spreads=self.spreads[rows]
        )

    def check(self, n: int) -> None:
        """Refuse what cannot be the strangers of a contract for descriptors of n numbers.

        Raises
        ------
        ContractError
        """
        count = len(self.people) if self.people.ndim else 0
        least, most = SIZES
        if not least <= count <= most:
            raise ContractError(f"a contract must have {least} to {most} strangers")
        if self.people.shape != (count, n) or self.generator.n != n:
            raise ContractError("the strangers' dimension differs from the binding's")
        if self.means.shape != (count,) or self.spreads.shape != (count,):
            raise ContractError("the strangers' means or spreads are not one for each")
        arrays = (self.people, self.means, self.spreads)
        if any(array.dtype != np.float32 for array in arrays):
            raise ContractError("the strangers are not float32")
        if not all(np.isfinite(array).all() for array in arrays):
            raise ContractError("the strangers hold a number that is not finite")
        lengths = np.linalg.norm(self.people.astype(np.float64), axis=1)
        if float(np.abs(lengths - 1).max()) > UNIT_TOLERANCE:
            raise ContractError("a stranger is not a unit vector")
        if float(np.abs(self.means).max()) > 1 + UNIT_TOLERANCE or float(self.spreads.min()) <= 0:
            raise ContractError("the strangers' means or spreads are out of range")

    @cached_property
    def _generator_bytes(self) -> bytes:
        return self.generator.to_bytes()

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Arrays that :meth:`from_tensors` reads."""
        return {
            "people": np.ascontiguousarray(self.people),
            "means": np.ascontiguousarray(self.means),
            "spreads": np.ascontiguousarray(self.spreads),
            "generator": np.frombuffer(self._generator_bytes, dtype=np.uint8),
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, NDArray[np.generic]]) -> "Nobody":
        """Read what :meth:`tensors` gave; the contract checks the numbers.

        Raises
        ------
        ContractError, DecoyError
            Where they cannot be that.
        """
        generator = tensors["generator"]
        if generator.dtype != np.uint8 or generator.ndim != 1:
            raise ContractError("the contract's generator is not a row of bytes")
        for name in ("people", "means", "spreads"):
            if tensors[name].dtype != np.float32:
                raise ContractError("the strangers are not float32")
        return cls(
            people=np.asarray(tensors["people"], dtype=np.float32),
            means=np.asarray(tensors["means"], dtype=np.float32),
            spreads=np.asarray(tensors["spreads"], dtype=np.float32),
            generator=DecoyGenerator.from_bytes(generator.tobytes()),
        )

    def score(self, template: AffineSubspace, *, metric: Metric, steps: int) -> float:
        """Say how near a template, un-rotated, lies to strangers.

        Returns
        -------
        float
            log(mean exp(2 z)) / 2 over the strangers' cohort scores z: 1 were z a standard normal
            variable. It rises with the mean and the spread of z, and with the share of strangers
            far above the mean, by Chernoff's bound: P(z > a) < exp(2 (score − a)).
        """
        batch = SubspaceBatch.of([template])
        distances = pairwise_distances(self.people, batch, metric=metric, steps=steps)
        near = np.asarray(similarity(distances), dtype=np.float64)[:, 0]
        tilted = TILT * (near - self.means) / self.spreads
        largest = float(tilted.max())
        return (largest + float(np.log(np.mean(np.exp(tilted - largest))))) / TILT

    def lift(self, *, strategy: Strategy, m: int, stream: Keystream) -> AffineSubspace:
        """Lift one of the strangers, drawn from ``stream``: a template of nobody, un-rotated."""
        # No multiple of the number of strangers, but the bias is below 1 in 10¹³.
        row = int(stream.uniform((1,))[0] * len(self.people))
        point = self.people[row].astype(np.float64)
        span = span_basis(
            draw_directions(
                point[None], strategy=strategy, m=m, source=self.generator, stream=stream
            )
        )[0]
        return AffineSubspace(
            foot=(point - span.T @ (span @ point)).astype(np.float32),
            basis=span.astype(np.float32),
        )
