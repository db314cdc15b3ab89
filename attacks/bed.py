"""The bed that every attack acts on: people, their templates, and what an attacker has."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from attacks.outcomes import GENERATED, POOLED, AuditError, Scheme
from attacks.second_order import Moments
from templates.contract.document import Calibration, Contract, Level
from templates.contract.nobody import Nobody
from templates.decoys import DecoyPool, DecoySource
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift, plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.comparisons import through_wire

LEAST_VICTIMS = 100
LEAST_FACES = 1_000
"""Of people and of the attacker's faces; with fewer, attacks that are known to work do not. On LFW
at m = 128, 194 faces matched 13 of 40 people, and 3,512 more matched 32 of the same."""

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Pairs:
    """What some people enroll, and another photo of each; unit rows.

    Parameters
    ----------
    enrolled, fresh : (P, n) float32
        The same rows where nobody has two photos.
    """

    enrolled: Array32
    fresh: Array32

    def __len__(self) -> int:
        return len(self.enrolled)

    def __getitem__(self, rows: slice) -> "Pairs":
        return Pairs(self.enrolled[rows], self.fresh[rows])

    def along(self, source: DecoySource) -> "Pairs":
        """Take embeddings to the coordinates that templates have."""
        if not len(self):
            empty = np.empty((0, source.k), dtype=np.float32)
            return Pairs(empty, empty)
        return Pairs(source.project(self.enrolled), source.project(self.fresh))

    @classmethod
    def of(
        cls,
        embeddings: Array32,
        person: NDArray[np.int64],
        people: NDArray[np.int64],
        *,
        photos: int,
        rng: np.random.Generator,
    ) -> "Pairs":
        """Enroll up to ``photos`` photos of each of some people, and keep another one fresh.

        Where a person has a single photo, it is both.
        """
        enrolled = np.empty((len(people), embeddings.shape[1]))
        fresh = np.empty_like(enrolled)
        for place, one in enumerate(people):
            album = rng.permutation(np.flatnonzero(person == one))
            fresh[place] = embeddings[album[0]]
            enrolled[place] = embeddings[album[1 : photos + 1] if len(album) > 1 else album].mean(0)
        return cls(normalised(enrolled).astype(np.float32), fresh.astype(np.float32))


@dataclass(frozen=True, eq=False, repr=False)
class Attacker:
    """Second moments of faces, as one attacker knows them.

    Parameters
    ----------
    faces
        Faces or people that the attacker has; None where it knows their second moments exactly.
    counted
        How it counts them.
    """

    faces: int | None
    counted: str
    moments: Moments


@dataclass(frozen=True, eq=False, repr=False)
class Testbed:
    """People to attack in the coordinates that templates have, and what an attacker has.

    Parameters
    ----------
    victims
        Of (V, k) rows; ``victims.enrolled`` is the truth that an attack wants.
    templates : SubspaceBatch of V
        One template of each victim, un-rotated unless the runner has turned them.
    source
        Decoys of k numbers.
    decoys
        Their second moments.
    attackers
        Those who know second moments, by the faces that they have and how they count them.
    gallery : (A, k) float32
        Faces of other people, which the attacker has: one photo of each.
    match_cosine
        Cosine to the fresh photo from which on a guess is a match: raw FMR 1e-3, in the same
        coordinates.
    drawn
        People whose second moments an attacker knows exactly: one with unlimited faces. Their
        victims are drawn, and they have one attacker. None where decoys are a pool's.
    contract
        What decides about probes, calibrated on people who are not attacked. None where attacks
        guess embeddings only.
    albums
        Embeddings of all photos, (i, n), of each victim with three or more.
    owners
        People whose ``enrolled`` photos make up the pool of decoys.
    batches
        Several templates of each victim, where an attack has them.
    """

    __test__ = False

    victims: Pairs
    templates: SubspaceBatch
    source: DecoySource
    decoys: Moments
    attackers: tuple[Attacker, ...]
    gallery: Array32
    match_cosine: float
    strategy: Strategy
    seed: int
    drawn: "Testbed | None" = None
    contract: Contract | None = None
    albums: tuple[Array32, ...] = ()
    owners: Pairs | None = None
    batches: tuple[SubspaceBatch, ...] = ()

    @property
    def m(self) -> int:
        """Dimension of the templates."""
        return self.templates.m

    @property
    def scheme(self) -> Scheme:
        """How the templates protect."""
        source = POOLED if isinstance(self.source, DecoyPool) else GENERATED
        decoys = source if self.strategy.needs_decoys else None
        return Scheme(
            self.strategy, decoys, self.m, self.source.k if self.source.k < self.source.n else None
        )

    @property
    def pool(self) -> DecoyPool | None:
        """The pool that the decoys are drawn from; None of another scheme."""
        of_pool = self.scheme.decoys == POOLED and isinstance(self.source, DecoyPool)
        return self.source if of_pool and isinstance(self.source, DecoyPool) else None

    def lift(self, points: Array32, *purpose: str | int, m: int | None = None) -> SubspaceBatch:
        """Lift further points, (N, k), as they are stored; with randomness of this purpose only.

        Strategies that need labels or sub-databases are lifted in their plain form.
        """
        m = m or self.m
        stream = Keystream.seeded("privacy", self.seed, self.source.k, m, *purpose)
        lifted = lift(
            points,
            strategy=plain_strategy(self.strategy),
            m=m,
            source=self.source,
            stream=stream,
        )
        if self.contract is None:
            return as_stored(lifted)
        return through_wire(lifted, contract_id=self.contract.contract_id)

    def at(self, m: int, *purpose: str) -> "Testbed":
        """Lift the victims anew, with m decoys."""
        drawn = None if self.drawn is None else self.drawn.at(m, *purpose)
        return replace(self, templates=self.lift(self.victims.enrolled, *purpose, m=m), drawn=drawn)

    def first(self, count: int) -> "Testbed":
        """Return the bed of the first victims only, for attacks that take long."""
        return replace(self, victims=self.victims[:count], templates=self.templates[:count])

    @cached_property
    def renewed(self) -> SubspaceBatch:
        """Templates of the victims' fresh photos, lifted once."""
        return self.lift(self.victims.fresh, "renewed from the fresh photo")

    @property
    def service(self) -> Contract:
        """The contract that decides.

        Raises
        ------
        AuditError
            There is none: nothing can be presented.
        """
        if self.contract is None:
            raise AuditError("an attack on the decision needs a contract")
        return self.contract

    @property
    def nobody(self) -> Nobody:
        """Templates of nobody under the contract."""
        return self.service.nobody(self.source)

    @property
    def points(self) -> Calibration:
        """The calibration of raw probes."""
        return self.service.calibration("p2s")

    @property
    def lifted(self) -> Calibration | None:
        """The calibration of lifted probes, of the largest dimension; None without any.

        The largest is where lifted wolves open most (docs/method.md §4.7).
        """
        calibrations = [one for one in self.service.calibrations if one.mode == "s2s"]
        return max(calibrations, key=lambda one: one.probe_m, default=None)

    @property
    def level(self) -> Level:
        """The level that the service decides with by default."""
        return self.points.level(self.service.default_level)


def as_stored(templates: SubspaceBatch) -> SubspaceBatch:
    """Round to half precision, as the wire format does."""
    return SubspaceBatch(
        templates.feet.astype(np.float16).astype(np.float32),
        templates.bases.astype(np.float16).astype(np.float32),
    )
