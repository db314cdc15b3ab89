"""The bed that every attack acts on: people, their templates, and what an attacker has.

``veilface calibrate`` and ``veilface audit templates`` make it alike, so that they judge the same
attackers by the same limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.outcomes import GENERATED, POOLED, Scheme
from attacks.second_order import (
    Moments,
    as_far_as_faces,
    decoy_moment,
    drawn_towards,
    moment_on_sphere,
)
from templates.contract.document import Calibration, Contract, Level
from templates.contract.nobody import Nobody
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift, plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.comparisons import through_wire
from verify.consistency import match_cosine

FACE_COUNTS = (1_000, 5_000)
MOST_ATTACKED = 600
LEAST_VICTIMS = 100
LEAST_FACES = 1_000
"""Of people and of the attacker's faces; with fewer, attacks that are known to work do not. On LFW
at m = 128, 194 faces found 13 of 40 people, and 3,512 more found 32 of the same."""
DRAWN_PEOPLE = 600
PHOTOS, ONE_PHOTO, MEANS = "photos", "one photo of each person", "the mean of each person"
EXACT = "exact moments"
_FEWER = 0.8
"""An attacker with nearly all faces is not worth a row beside the one that has them all."""

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


@dataclass(frozen=True)
class Effort:
    """How hard the attacks that take long try.

    ``climbed``: victims whose template is climbed by scores, in ``attempts`` each.
    ``training_seconds`` is for the inverter; None trains none.
    """

    climbed: int = 10
    attempts: int = 1000
    training_seconds: float | None = None


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
        Embeddings of all photos, (i, n), of each victim who has three or more.
    owners
        People whose ``enrolled`` photos make up the pool of decoys.
    batches
        Several templates of each victim, where an attack has them.
    memory
        What an attack has learnt, for the same attack on other templates.
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
    effort: Effort = field(default_factory=Effort)
    memory: dict[object, Any] = field(default_factory=dict)

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
        with Keystream.seeded("privacy", self.seed, self.source.k, m, *purpose) as stream:
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
        """The calibration of lifted probes, of the largest dimension; None where there is none.

        The largest is where lifted wolves open most (docs/method.md §4.7).
        """
        calibrations = [one for one in self.service.calibrations if one.mode == "s2s"]
        return max(calibrations, key=lambda one: one.probe_m, default=None)

    @property
    def level(self) -> Level:
        """The level that the service decides with by default."""
        return self.points.level(self.service.default_level)


@dataclass(frozen=True, eq=False, repr=False)
class AttackSetup:
    """People to attack, and the faces of others that attackers have; embeddings of n numbers.

    Parameters
    ----------
    victims, mates
        Who is attacked; and others with two photos or more, none of the attacked, whom the price
        in accuracy is estimated on.
    faces : (A, n) float32
        Of other people: the attacker's.
    owners : (A,) int64
        Whose each is; all different where that is not known.
    source
        Decoys, with all of their axes.
    photos
        Most that are averaged into what is enrolled.
    """

    victims: Pairs
    mates: Pairs
    faces: Array32
    owners: NDArray[np.int64]
    source: DecoySource
    photos: int
    seed: int

    @classmethod
    def of(
        cls,
        victims: Pairs,
        faces: Array32,
        source: DecoySource,
        *,
        owners: NDArray[np.int64] | None = None,
        mates: Pairs | None = None,
        photos: int = 3,
        seed: int = 0,
    ) -> "AttackSetup":
        """Shuffle the attacker's faces.

        Parameters
        ----------
        victims
            People who are in no fit and none of the attacker's.
        faces : (A, n) float32
            Of other people of the same kind.
        owners : (A,) int64
            Whose each is; None: of a person of its own.

        Raises
        ------
        AuditError
            Fewer than two faces, nobody to attack, or embeddings of other dimensions.
        """
        if len(faces) < 2 or not len(victims) or victims.enrolled.shape != victims.fresh.shape:
            raise AuditError("privacy is measured on people with a fresh photo each, and on faces")
        if not victims.enrolled.shape[1] == faces.shape[1] == source.n:
            raise AuditError(f"the decoys are of {source.n} numbers, and the faces of others")
        order = np.random.default_rng([seed, 1]).permutation(len(faces))
        return cls(
            victims,
            victims[:0] if mates is None else mates,
            np.asarray(faces, dtype=np.float32)[order],
            order if owners is None else np.asarray(owners, dtype=np.int64)[order],
            source,
            photos,
            seed,
        )

    @classmethod
    def of_people(
        cls,
        embeddings: Array32,
        identities: Sequence[str],
        source: DecoySource,
        *,
        photos: int,
        seed: int,
    ) -> "AttackSetup":
        """Prepare from photos (N, n) of named people: half of the people at most are attacked.

        Of those with two photos or more: one photo is fresh, up to ``photos`` others are enrolled.
        Where so few have two that they show little, people with one are attacked as well: a guess
        must match the very photo that is enrolled, which is harsher.
        All photos of the others are the attacker's.
        """
        person = np.unique(np.asarray(identities), return_inverse=True)[1]
        rows = np.asarray(embeddings, dtype=np.float32)
        rng = np.random.default_rng([seed, 3])
        counts = np.bincount(person)
        several = rng.permutation(np.flatnonzero(counts > 1))
        willing, most = several, min(MOST_ATTACKED, len(counts) // 2)
        if len(several) < min(2 * LEAST_VICTIMS, most):
            willing = np.concatenate([several, rng.permutation(np.flatnonzero(counts == 1))])
            most = min(most, 2 * LEAST_VICTIMS) if len(several) else most
        others = ~np.isin(person, willing[:most])
        mates = several[most : most + MOST_ATTACKED]
        return cls.of(
            Pairs.of(rows, person, willing[:most], photos=photos, rng=rng),
            rows[others],
            source,
            owners=person[others],
            mates=Pairs.of(rows, person, mates, photos=photos, rng=rng),
            photos=photos,
            seed=seed,
        )

    def halves(self) -> tuple["AttackSetup", "AttackSetup"]:
        """Part the victims: to choose by, and to judge by, of whom a verdict needs 100.

        Those to choose by may be none. People who are drawn are others for either half.
        """
        count = len(self.victims)
        chosen_by = max(0, min(count // 2, count - LEAST_VICTIMS))
        return (
            replace(self, victims=self.victims[:chosen_by]),
            replace(self, victims=self.victims[chosen_by:], seed=self.seed + 1),
        )

    @cached_property
    def counted(self) -> tuple[tuple[str, Array32], ...]:
        """The attacker's faces in the ways that they may be counted, (A, n) and fewer."""
        people, first, owner = np.unique(self.owners, return_index=True, return_inverse=True)
        if len(people) == len(self.owners):
            return ((PHOTOS, self.faces),)
        sums = np.zeros((len(people), self.faces.shape[1]))
        places = np.zeros(len(people), dtype=np.int64)
        for row, one in enumerate(owner):
            if places[one] < self.photos:
                sums[one] += self.faces[row]
                places[one] += 1
        shuffled = np.argsort(first)
        return (
            (PHOTOS, self.faces),
            (ONE_PHOTO, self.faces[np.sort(first)]),
            (MEANS, normalised(sums).astype(np.float32)[shuffled]),
        )

    def bed(
        self,
        strategy: Strategy,
        *,
        axes: int,
        m: int,
        quick: bool = False,
        contract: Contract | None = None,
    ) -> Testbed:
        """Project on the leading axes, lift the victims, and let attackers estimate what they can.

        Parameters
        ----------
        quick
            Only attackers with all faces.
        contract
            What decides about probes; None where none are sent.
        """
        source = self.source.reduced(axes)
        decoys = Moments.of(decoy_moment(source))
        attackers = []
        for name, faces in self.counted:
            rows = source.project(faces)
            for count in (len(rows),) if quick else face_counts(len(rows)):
                moments = Moments.of(drawn_towards(rows[:count], decoys.moment))
                attackers.append(Attacker(count, name, moments))
        names = [str(one) for one in self.owners]
        nothing = SubspaceBatch(
            np.empty((0, source.k), np.float32), np.empty((0, m, source.k), np.float32)
        )
        bed = Testbed(
            self.victims.along(source),
            nothing,
            source,
            decoys,
            tuple(attackers),
            source.project(dict(self.counted).get(ONE_PHOTO, self.faces)),
            match_cosine(source.project(self.faces), names, seed=self.seed),
            strategy,
            self.seed,
            contract=contract,
        )
        return replace(bed, drawn=self._drawn(bed)).at(m)

    def _drawn(self, bed: Testbed) -> Testbed | None:
        """Draw people whose second moments an attacker knows exactly: one with unlimited faces.

        Their moments are as far from the decoys' as those of the faces at hand are
        (:func:`as_far_as_faces`), and they are lifted with the deployment's own decoys. A fresh
        photo is drawn as near to what is enrolled as those of real people are. None where decoys
        are a pool's, or nobody is attacked.
        """
        known = self.victims if len(self.victims) else self.mates
        if not isinstance(bed.source, DecoyGenerator) or not len(known):
            return None
        pairs = known.along(bed.source)
        genuine = np.einsum("ij,ij->i", pairs.enrolled, pairs.fresh, dtype=np.float64)
        rows = bed.source.project(self.counted[-1][1])
        mean = rows.mean(axis=0, dtype=np.float64)
        covariance = as_far_as_faces(rows, bed.decoys) - np.outer(mean, mean)
        values, axes = np.linalg.eigh(covariance)
        root = (axes * np.sqrt(np.maximum(values, 0))).T
        rng = np.random.default_rng([self.seed, 2])
        enrolled, others = (
            normalised(mean + rng.standard_normal((DRAWN_PEOPLE, len(root))) @ root)
            for _ in range(2)
        )
        others = normalised(others - np.sum(others * enrolled, axis=1, keepdims=True) * enrolled)
        cosines = np.clip(rng.choice(genuine, DRAWN_PEOPLE), -1, 1)[:, None]
        fresh = cosines * enrolled + np.sqrt(1 - cosines**2) * others
        exact = Moments.of(moment_on_sphere(mean, root.T @ root))
        return replace(
            bed,
            victims=Pairs(enrolled.astype(np.float32), fresh.astype(np.float32)),
            attackers=(Attacker(None, EXACT, exact),),
        )


def face_counts(total: int) -> tuple[int, ...]:
    """Numbers of faces that attackers have, up to all that there are."""
    return (*(count for count in FACE_COUNTS if count < _FEWER * total), total)


def as_stored(templates: SubspaceBatch) -> SubspaceBatch:
    """Round to half precision, as the wire format does."""
    return SubspaceBatch(
        templates.feet.astype(np.float16).astype(np.float32),
        templates.bases.astype(np.float16).astype(np.float32),
    )
