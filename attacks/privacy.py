"""How many templates the strongest attacker opens who knows second moments: one figure for a pair.

``veilface calibrate`` chooses the axes and the dimension by it and judges them by it, and an audit
reports the same attack. The attackers differ in the faces that they have, 1,000, 5,000, and all
that there are, and in how they count them: every photo, one photo of each person, or the mean of a
person's photos, as people are enrolled. One without limit is simulated, because nobody has faces
without limit. The verdict is that of the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.second_order import (
    Moments,
    as_far_as_faces,
    decoy_moment,
    drawn_towards,
    likeliest_embeddings,
    moment_on_sphere,
)
from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift, plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.consistency import match_cosine
from verify.metrics import rate

FACE_COUNTS = (1_000, 5_000)
MOST_ATTACKED = 600
LEAST_VICTIMS = 100
LEAST_FACES = 1_000
"""Of people and of the attacker's faces; with fewer, attacks that are known to work do not. On LFW
at m = 128, 194 faces found 13 of 40 people, and 3,512 more found 32 of the same."""
SPHERE_SHARES = (0.15, 0.3, 0.5, 0.7)
"""Shares of the decoys' moments, beside the sphere's, that templates with random directions are
attacked with. The best counts; on real faces that was 0.3."""
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


@dataclass(frozen=True)
class Theft:
    """What one attacker gets.

    Parameters
    ----------
    attack
        ``foot point`` or ``second moments``.
    faces
        Faces or people that the attacker has; None where it knows their second moments exactly.
    counted
        How it counts them.
    share
        Of the decoys' moments beside the sphere's; 1 where all directions lead to decoys.
    found
        Templates whose guess matches a fresh photo of the person.
    control
        Those whose guess matches the photo of the next person, as should happen by chance only.
    """

    attack: str
    faces: int | None
    counted: str
    share: float
    found: Rate
    control: Rate

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "attack": self.attack,
            "faces": "unlimited, simulated" if self.faces is None else self.faces,
            "counted": self.counted,
            "share_of_decoys": self.share,
            "found": self.found.to_json(),
            "control": self.control.to_json(),
        }


@dataclass(frozen=True, eq=False, repr=False)
class Attacker:
    """Second moments of faces, as one attacker knows them; see :class:`Theft` for the fields."""

    faces: int | None
    counted: str
    moments: Moments


@dataclass(frozen=True, eq=False, repr=False)
class TestBed:
    """People to attack in the coordinates that templates have, and who attacks them.

    Parameters
    ----------
    victims
        Of (V, k) rows.
    source
        Decoys of k numbers.
    decoys
        Their second moments.
    match_cosine
        Cosine to the fresh photo from which on a guess is a match: raw FMR 1e-3, in the same
        coordinates.
    """

    __test__ = False

    victims: Pairs
    source: DecoySource
    decoys: Moments
    attackers: tuple[Attacker, ...]
    match_cosine: float
    seed: int

    def lifted(self, strategy: Strategy, m: int) -> SubspaceBatch:
        """Lift the victims, with randomness of the seed, and round as the wire format does."""
        with Keystream.seeded("privacy", self.seed, self.source.k, m) as stream:
            templates = lift(
                self.victims.enrolled,
                strategy=plain_strategy(strategy),
                m=m,
                source=self.source,
                stream=stream,
            )
        return as_stored(templates)

    def decoy_forms(self, strategy: Strategy, m: int) -> tuple[tuple[float, Moments], ...]:
        """Moments of what surrounds an embedding in a template, with the share that is decoys'."""
        decoys = plain_strategy(strategy).decoys(m)
        if decoys == m:
            return ((1.0, self.decoys),)
        shares = SPHERE_SHARES if decoys else (0.0,)
        return tuple((share, self.decoys.with_sphere(share)) for share in shares)

    def thefts(self, strategy: Strategy, m: int) -> tuple[Theft, ...]:
        """What every attacker gets from templates of a strategy and dimension.

        Parameters
        ----------
        strategy
            Strategies that need labels or sub-databases are lifted in their plain form.
        """
        templates = self.lifted(strategy, m)
        feet = templates.feet / np.maximum(templates.foot_norms, 1e-12)[:, None]
        thefts = [self._theft("foot point", 0, "nothing", 1.0, feet)]
        for share, decoys in self.decoy_forms(strategy, m):
            for attacker in self.attackers:
                guesses = likeliest_embeddings(templates, attacker.moments, decoys)
                thefts.append(
                    self._theft("second moments", attacker.faces, attacker.counted, share, guesses)
                )
        return tuple(thefts)

    def _theft(
        self, attack: str, faces: int | None, counted: str, share: float, guesses: Array64 | Array32
    ) -> Theft:
        fresh, cosine = self.victims.fresh, self.match_cosine
        return Theft(
            attack,
            faces,
            counted,
            share,
            matches(guesses, fresh, cosine),
            matches(guesses, np.roll(fresh, 1, axis=0), cosine),
        )


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

    def along(self, axes: int, *, quick: bool = False) -> TestBed:
        """Project on the leading axes, and let attackers estimate what they can.

        Parameters
        ----------
        quick
            Only attackers with all faces.
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
        return TestBed(
            self.victims.along(source),
            source,
            decoys,
            tuple(attackers),
            match_cosine(source.project(self.faces), names, seed=self.seed),
            self.seed,
        )

    def simulated(self, bed: TestBed) -> TestBed | None:
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

        def drawn() -> Array64:
            return normalised(mean + rng.standard_normal((DRAWN_PEOPLE, len(root))) @ root)

        enrolled, others = drawn(), drawn()
        others = normalised(others - np.sum(others * enrolled, axis=1, keepdims=True) * enrolled)
        cosines = np.clip(rng.choice(genuine, DRAWN_PEOPLE), -1, 1)[:, None]
        fresh = cosines * enrolled + np.sqrt(1 - cosines**2) * others
        exact = Moments.of(moment_on_sphere(mean, root.T @ root))
        return replace(
            bed,
            victims=Pairs(enrolled.astype(np.float32), fresh.astype(np.float32)),
            attackers=(Attacker(None, EXACT, exact),),
        )


def all_thefts(setup: AttackSetup, strategy: Strategy, *, axes: int, m: int) -> tuple[Theft, ...]:
    """What every attacker gets: with faces, from the victims; without limit, from drawn people."""
    bed = setup.along(axes)
    drawn = setup.simulated(bed)
    thefts = bed.thefts(strategy, m)
    return thefts if drawn is None else (*thefts, *drawn.thefts(strategy, m)[1:])


def face_counts(total: int) -> tuple[int, ...]:
    """Numbers of faces that attackers have, up to all that there are."""
    return (*(count for count in FACE_COUNTS if count < _FEWER * total), total)


def as_stored(templates: SubspaceBatch) -> SubspaceBatch:
    """Round to half precision, as the wire format does."""
    return SubspaceBatch(
        templates.feet.astype(np.float16).astype(np.float32),
        templates.bases.astype(np.float16).astype(np.float32),
    )


def matches(
    guesses: NDArray[np.floating], fresh: NDArray[np.floating], match_cosine: float
) -> Rate:
    """Share of guesses (V, k) that match a fresh photo (V, k)."""
    hits = np.einsum("ij,ij->i", guesses, fresh) >= match_cosine
    return rate(int(np.count_nonzero(hits)), len(hits))
