"""People to attack, and the faces of others, from which a bed is made for any axes and dimension.

``veilface calibrate`` and ``veilface audit templates`` make beds by it alike, so that they judge
the same attackers by the same limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from attacks.bed import LEAST_VICTIMS, Attacker, Pairs, Testbed
from attacks.outcomes import AuditError
from attacks.second_order import (
    Moments,
    as_far_as_faces,
    decoy_moment,
    drawn_towards,
    moment_on_sphere,
)
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoySource
from templates.space.embedding import normalised
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch
from verify.consistency import match_cosine

FACE_COUNTS = (1_000, 5_000)
MOST_ATTACKED = 600
DRAWN_PEOPLE = 600
PHOTOS, ONE_PHOTO, MEANS = "photos", "one photo of each person", "the mean of each person"
EXACT = "exact moments"
_FEWER = 0.8
"""An attacker with nearly all faces is not worth a row beside the one that has them all."""

Array32 = NDArray[np.float32]


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
        """Shuffle the attacker's faces, which are of people of their own where owners are None.

        Raises
        ------
        AuditError
            Fewer than two faces, or nobody to attack.
        """
        if len(faces) < 2 or not len(victims):
            raise AuditError("privacy is measured on people with a fresh photo each, and on faces")
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

        ``quick`` has only attackers with all faces; ``contract`` decides about probes, where sent.
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
