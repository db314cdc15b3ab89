"""Descriptors of nobody, spread like those of enrolled people: a contract's sealed strangers.

They serve three times. A template that a client sends is held against them: one that lies near
strangers on purpose, a *wolf*, lies near these too, whom its maker cannot know. A subject that does
not exist is decided against a template that was lifted from one of them (``verify.stand_ins``). And
lifted probes are normalised by a cohort of templates that are lifted from some of them, always the
same, from a secret seed.
"""

import hashlib
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from templates.contract.expectation import PointExpectation
from templates.decoys.generator import DecoyGenerator
from templates.decoys.source import checked_noise
from templates.decoys.statistics import DescriptorStatistics
from templates.distances import pairwise_distances, similarity
from templates.errors import ContractError
from templates.keys.randomness import KEY_BYTES, Keystream
from templates.space.embedding import UNIT_TOLERANCE
from templates.space.lifting import Strategy, lift, lift_of_nobody
from templates.space.rounded import RoundedBatch
from templates.space.subspace import AffineSubspace, SubspaceBatch

SIZES = (2, 65_536)
COHORT_SIZE = 400
"""Templates in a cohort. The score of a lifted wolf rests on the cohort's mean and standard
deviation as that wolf sees them, and with 150 their sampling error alone let single wolves reach 3
to 4 % of templates at FMR 1e-2 (docs/decision.md §1); a larger cohort costs time at every
decision."""
TILT = 2.0
"""Weight of near strangers in :meth:`Nobody.score`: one 3 standard deviations above the mean counts
e⁶ = 403 times as much as one at the mean, and an honest template's score still rests on many of
them."""
_STATISTICS = ("mean", "axes", "weights", "centres", "spreads")
NOBODY_TENSORS = frozenset({"people", "seed", "noise", *_STATISTICS})
_HALF = np.float16
_WIDE = frozenset({"people", "axes"})
_KINDS: dict[str, type[np.generic]] = {
    "seed": np.uint8,
    "noise": np.float64,
    **dict.fromkeys(_WIDE, _HALF),
}


@dataclass(frozen=True, eq=False, repr=False)
class Nobody:
    """Strangers who do not exist, and what lifts templates of them.

    Parameters
    ----------
    halves : (K, n) float16
        The strangers, as a contract file keeps them. Secret: who has them can make a wolf that
        they do not see.
    generator
        Decoys of templates of nobody: those that lifting clients take, with axes that were rounded
        to float16 (:meth:`of`).
    seed
        32 bytes that the cohort is lifted with. Secret.
    """

    halves: NDArray[np.float16]
    generator: DecoyGenerator
    seed: bytes = field(repr=False)

    @classmethod
    def of(cls, people: NDArray[np.float32], generator: DecoyGenerator, *, seed: bytes) -> "Nobody":
        """Keep strangers, (K, n) unit rows, and a generator in half the bytes."""
        known = generator.statistics
        rounded = DescriptorStatistics(
            mean=known.mean,
            axes=known.axes.astype(_HALF).astype(np.float32),
            weights=known.weights,
            centres=known.centres,
            spreads=known.spreads,
        )
        rounded_generator = DecoyGenerator(rounded, noise=generator.noise)
        return cls(people.astype(_HALF), rounded_generator, seed)

    @cached_property
    def people(self) -> NDArray[np.float32]:
        """The strangers, (K, n) unit rows."""
        rows = self.halves.astype(np.float64)
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)

    def __len__(self) -> int:
        return len(self.halves)

    def check(self, n: int) -> None:
        """Refuse what cannot be the strangers of a contract for descriptors of n numbers.

        Raises
        ------
        ContractError
        """
        count = len(self.halves) if self.halves.ndim else 0
        least, most = SIZES
        if not least <= count <= most:
            raise ContractError(f"a contract must have {least} to {most} strangers")
        if self.halves.shape != (count, n) or self.generator.n != n:
            raise ContractError("the strangers' dimension differs from the binding's")
        if len(self.seed) != KEY_BYTES:
            raise ContractError(f"the cohort's seed must have {KEY_BYTES} bytes")
        rows = self.halves.astype(np.float64)
        if not np.isfinite(rows).all():
            raise ContractError("the strangers hold a number that is not finite")
        if float(np.abs(np.linalg.norm(rows, axis=1) - 1).max()) > UNIT_TOLERANCE:
            raise ContractError("a stranger is not a unit vector")

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 over strangers, generator and seed."""
        digester = hashlib.sha256(str(self.halves.shape).encode())
        digester.update(self.halves.astype("<f2", copy=False).tobytes())
        digester.update(self.generator.source_id.encode("ascii"))
        digester.update(self.seed)
        return digester.digest()

    def tensors(self) -> dict[str, NDArray[np.generic]]:
        """Arrays that :meth:`from_tensors` reads."""
        statistics = self.generator.statistics
        return {
            "people": np.ascontiguousarray(self.halves),
            "seed": np.frombuffer(self.seed, dtype=np.uint8),
            "noise": np.array([self.generator.noise]),
            **{
                name: np.ascontiguousarray(
                    getattr(statistics, name), dtype=_HALF if name in _WIDE else np.float32
                )
                for name in _STATISTICS
            },
        }

    @classmethod
    def from_tensors(cls, tensors: dict[str, NDArray[np.generic]]) -> "Nobody":
        """Read what :meth:`tensors` gave; the contract checks the numbers.

        Raises
        ------
        ContractError, DecoyError
            Where they cannot be that.
        """
        for name, array in tensors.items():
            kind = _KINDS.get(name, np.float32)
            if array.dtype != kind:
                raise ContractError(f"the strangers' {name} is not {np.dtype(kind).name}")
        if tensors["noise"].shape != (1,):
            raise ContractError("the strangers' noise is not one number")
        noise = checked_noise(repr(float(tensors["noise"][0])))
        statistics = {name: np.asarray(tensors[name], dtype=np.float32) for name in _STATISTICS}
        return cls(
            halves=np.asarray(tensors["people"], dtype=_HALF),
            generator=DecoyGenerator(DescriptorStatistics(**statistics), noise=noise),
            seed=tensors["seed"].tobytes(),
        )

    def score(self, template: AffineSubspace, expectation: PointExpectation) -> float:
        """Say how near a template, un-rotated, lies to strangers (:meth:`scores`)."""
        return float(self.scores(SubspaceBatch.of([template]), expectation)[0])

    def scores(
        self,
        templates: SubspaceBatch,
        expectation: PointExpectation,
        *,
        rows: slice = slice(None),
    ) -> NDArray[np.float64]:
        """Say how near templates, un-rotated, lie to strangers.

        Parameters
        ----------
        rows
            The strangers that count.

        Returns
        -------
        ndarray of float64, shape (T,)
            log(mean exp(2 z)) / 2 over the strangers' scores z: 1 were z a standard normal
            variable. It rises with the mean and the spread of z, and with the share of strangers
            far above the mean, by Chernoff's bound: P(z > a) < exp(2 (score − a)).
        """
        means, spreads = (part[rows, None] for part in self._statistics(expectation))
        # A service scores one template at a time; in float64 it needs no compiled kernels for it.
        dtype = np.float64 if len(templates) == 1 else np.float32
        people = self.people[rows]
        distances = pairwise_distances(people, templates, metric=expectation.metric, dtype=dtype)
        near = np.asarray(similarity(distances), dtype=np.float64)
        tilted = TILT * (near - means) / spreads
        largest = tilted.max(axis=0)
        return np.asarray((largest + np.log(np.mean(np.exp(tilted - largest), axis=0))) / TILT)

    def _statistics(
        self, expectation: PointExpectation
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the strangers expect; kept, for one expectation is a contract's."""
        kept = self.__dict__.get("_kept")
        if kept is None or kept[0] is not expectation:
            kept = self.__dict__["_kept"] = (expectation, expectation.statistics(self.people))
        statistics: tuple[NDArray[np.float64], NDArray[np.float64]] = kept[1]
        return statistics

    def lift(self, *, strategy: Strategy, m: int, stream: Keystream) -> AffineSubspace:
        """Lift one of the strangers, drawn from ``stream``: a template of nobody, un-rotated."""
        # No multiple of the number of strangers, but the bias is below 1 in 10¹³.
        row = int(stream.uniform((1,))[0] * len(self.people))
        feet, bases = lift_of_nobody(
            self.people[row : row + 1], strategy=strategy, m=m, source=self.generator, stream=stream
        )
        return AffineSubspace(foot=feet[0].astype(np.float32), basis=bases[0].astype(np.float32))

    def cohort(self, *, strategy: Strategy, m: int) -> RoundedBatch:
        """Lift the cohort: ``COHORT_SIZE`` of the strangers at most, with the seed's randomness."""
        rows = np.linspace(0, len(self.people), min(COHORT_SIZE, len(self.people)), endpoint=False)
        with Keystream(self.seed) as stream:
            lifted = lift(
                self.people[rows.astype(np.int64)],
                strategy=strategy,
                m=m,
                source=self.generator,
                stream=stream,
            )
        return RoundedBatch.of(lifted)
