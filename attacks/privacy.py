"""How many templates the strongest attacker opens who knows second moments: one figure for an m.

``veilface calibrate`` chooses m by it, and an audit reports the same attack. The attackers differ
in the faces that they have: 1,000, 5,000, and all that there are. One without limit is simulated,
because nobody has faces without limit; what is left to it is the error that the decoy generator
made on the faces that it was fitted to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from attacks.second_order import (
    Moments,
    drawn_towards,
    likeliest_descriptors,
    second_moment,
    with_noise_moment,
)
from templates.contract.canonical import Json
from templates.contract.document import Rate
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.randomness import Keystream
from templates.space.embedding import normalised
from templates.space.lifting import Strategy, lift, plain_strategy
from templates.space.subspace import SubspaceBatch
from verify.cohort import client_source
from verify.metrics import rate

FACE_COUNTS = (1_000, 5_000)
MOST_LIFTED = 300
DRAWS = 20_000
_FEWER = 0.8
"""An attacker with nearly all faces is not worth a row beside the one that has them all."""

Array32 = NDArray[np.float32]
Array64 = NDArray[np.float64]


@dataclass(frozen=True)
class Theft:
    """What one attacker gets.

    Parameters
    ----------
    attack
        ``foot point`` or ``second moments``.
    faces
        Of other people, that the attacker has; None where it knows their second moments exactly.
    found
        Templates whose guess matches a fresh photo of the person.
    control
        Those whose guess matches the photo of the next person, as should happen by chance only.
    """

    attack: str
    faces: int | None
    found: Rate
    control: Rate

    @classmethod
    def of(
        cls,
        attack: str,
        faces: int | None,
        guesses: NDArray[np.floating],
        fresh: NDArray[np.floating],
        match_cosine: float,
    ) -> "Theft":
        """Score one guess (V, n) a person against fresh photos (V, n)."""
        return cls(
            attack,
            faces,
            matches(guesses, fresh, match_cosine),
            matches(guesses, np.roll(fresh, 1, axis=0), match_cosine),
        )

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "attack": self.attack,
            "faces": "unlimited, simulated" if self.faces is None else self.faces,
            "found": self.found.to_json(),
            "control": self.control.to_json(),
        }


@dataclass(frozen=True)
class Privacy:
    """What every attacker gets from templates of one strategy and dimension.

    Parameters
    ----------
    extrapolated
        As :func:`extrapolate` gives it; None where there are too few attackers.
    """

    strategy: Strategy
    m: int
    thefts: tuple[Theft, ...]
    extrapolated: float | None

    @property
    def strongest(self) -> Theft:
        """The attacker that opens the largest share of templates."""
        return max(self.thefts, key=lambda theft: theft.found.value)


@dataclass(frozen=True, eq=False, repr=False)
class SimulatedPeople:
    """People who are drawn, from second moments that the attacker knows, and decoys fitted to such.

    Parameters
    ----------
    enrolled, fresh : (V, n) float32
        Unit rows.
    source
        A generator that was fitted to further draws.
    faces, decoys
        Second moments of the people, and of the source.
    """

    enrolled: Array32
    fresh: Array32
    source: DecoySource
    faces: Moments
    decoys: Moments

    @classmethod
    def draw(
        cls,
        mean: Array64,
        moment: Array64,
        genuine: NDArray[np.floating],
        *,
        fitted_to: int | None = None,
        noise: float = 0.0,
        source: DecoySource | None = None,
        seed: int,
    ) -> "SimulatedPeople":
        """Draw normalised Gaussian people.

        Parameters
        ----------
        mean, moment : (n,), (n, n) float64
            Their mean, and second moment about the origin. Its own error does not matter: that of
            the generator, relative to it, depends on ``fitted_to`` and n alone.
        genuine : (V,) floating
            Cosines of what a person enrolls and a fresh photo, of real people: one is drawn each.
        fitted_to
            Number of faces that the deployment's generator was fitted to: as many draws are fitted
            to anew.
        noise
            Of that generator.
        source
            The deployment's own, instead of a fit.
        """
        rng = np.random.default_rng([seed, 2])
        values, axes = np.linalg.eigh(moment - np.outer(mean, mean))
        root = (axes * np.sqrt(np.maximum(values, 0))).T

        def faces(count: int) -> Array64:
            return normalised(mean + rng.standard_normal((count, len(root))) @ root)

        if source is None:
            if fitted_to is None:
                raise AuditError("simulated decoys are fitted to a number of faces")
            source = DecoyGenerator.fit(faces(fitted_to).astype(np.float32), noise=noise)
        enrolled = faces(len(genuine))
        others = faces(len(genuine))
        others = normalised(others - np.sum(others * enrolled, axis=1, keepdims=True) * enrolled)
        cosines = np.clip(np.asarray(genuine, dtype=np.float64), -1, 1)[:, None]
        fresh = cosines * enrolled + np.sqrt(1 - cosines**2) * others
        return cls(
            enrolled.astype(np.float32),
            fresh.astype(np.float32),
            source,
            Moments.of(with_noise_moment(second_moment(faces(_MANY)), source.noise)),
            decoy_moments(source, draws=_MANY, seed=seed),
        )

    def theft(self, strategy: Strategy, m: int, *, match_cosine: float, seed: int) -> Theft:
        """What the attacker without limit gets from their templates."""
        with Keystream.seeded("simulated people", seed, m) as stream:
            templates = lift(
                self.enrolled, strategy=strategy, m=m, source=self.source, stream=stream
            )
        count = strategy.decoys(m)
        guesses = likeliest_descriptors(as_stored(templates), self.faces, self.decoys, count=count)
        return Theft.of("second moments", None, guesses, self.fresh, match_cosine)


_MANY = 60_000
"""Draws whose second moments pass for exact ones, beside those of the generator's few thousand."""


@dataclass(frozen=True, eq=False, repr=False)
class AttackSetup:
    """Everything that does not depend on m: prepared once, used for every m that is tried.

    Parameters
    ----------
    enrolled, fresh : (V, n) float32
        What is lifted, and another photo of the same person; unit rows.
    faces : (A, n) float32
        Of other people: the attacker's.
    owners : (A,) int64
        Whose each is; all different where that is not known.
    decoys
        Second moments of the source; of a pool, those of the generator that clients receive for it.
    attackers
        By number of faces, second moments as that attacker estimates them.
    match_cosine
        Cosine to the fresh photo from which on a guess is a match.
    """

    enrolled: Array32
    fresh: Array32
    source: DecoySource
    faces: Array32
    owners: NDArray[np.int64]
    decoys: Moments
    attackers: tuple[tuple[int, Moments], ...]
    match_cosine: float
    seed: int

    @classmethod
    def of(
        cls,
        enrolled: Array32,
        fresh: Array32,
        attacker_faces: Array32,
        source: DecoySource,
        *,
        match_cosine: float,
        owners: NDArray[np.int64] | None = None,
        most: int = MOST_LIFTED,
        seed: int = 0,
    ) -> "AttackSetup":
        """Prepare the attackers.

        Parameters
        ----------
        enrolled, fresh : (V, n) float32
            Of people who are in no fit and none of the attacker's; the first ``most`` count.
        attacker_faces : (A, n) float32
            Of other people of the same kind.
        owners : (A,) int64
            Whose each is; None: of a person of its own.

        Raises
        ------
        AuditError
            Fewer than two faces, no people, or arrays that do not fit.
        """
        n = source.n
        if len(attacker_faces) < 2 or not len(enrolled) or enrolled.shape != fresh.shape:
            raise AuditError("privacy is measured on people with a fresh photo each, and on faces")
        if enrolled.shape[1] != n or attacker_faces.shape[1] != n:
            raise AuditError(f"the decoys have {n} dimensions, and the faces others")
        decoys = decoy_moments(source, seed=seed)
        order = np.random.default_rng([seed, 1]).permutation(len(attacker_faces))
        shuffled = np.asarray(attacker_faces)[order]
        attackers = tuple(
            (count, Moments.of(drawn_towards(shuffled[:count], decoys.moment, noise=source.noise)))
            for count in face_counts(len(shuffled))
        )
        chosen = slice(0, most)
        return cls(
            np.asarray(enrolled[chosen], dtype=np.float32),
            np.asarray(fresh[chosen], dtype=np.float32),
            source,
            shuffled,
            order if owners is None else np.asarray(owners, dtype=np.int64)[order],
            decoys,
            attackers,
            match_cosine,
            seed,
        )

    @classmethod
    def of_people(
        cls,
        descriptors: Array32,
        identities: Sequence[str],
        source: DecoySource,
        *,
        match_cosine: float,
        photos: int,
        seed: int,
    ) -> "AttackSetup":
        """Prepare from labelled photos (N, n): half of the people at most are attacked.

        Of those with two photos or more; one photo is fresh, up to ``photos`` others are enrolled.
        All photos of the others are the attacker's.
        """
        person = np.unique(np.asarray(identities), return_inverse=True)[1]
        rows = np.asarray(descriptors, dtype=np.float32)
        rng = np.random.default_rng([seed, 3])
        several = rng.permutation(np.flatnonzero(np.bincount(person) > 1))
        attacked = several[: min(MOST_LIFTED, (person.max() + 1) // 2)]
        albums = [rng.permutation(np.flatnonzero(person == one)) for one in attacked]
        if not albums:
            raise AuditError("nobody has two photos")
        others = ~np.isin(person, attacked)
        means = np.stack([rows[album[1 : photos + 1]].mean(axis=0) for album in albums])
        return cls.of(
            normalised(means).astype(np.float32),
            rows[[album[0] for album in albums]],
            rows[others],
            source,
            match_cosine=match_cosine,
            owners=person[others],
            seed=seed,
        )


def privacy_of(setup: AttackSetup, *, strategy: Strategy, m: int) -> Privacy:
    """Lift the people with fresh randomness of the setup's seed, and let every attacker guess.

    Parameters
    ----------
    strategy
        Strategies that need labels or sub-databases are lifted in their plain form.
    """
    plain = plain_strategy(strategy)
    with Keystream.seeded("privacy", setup.seed, m) as stream:
        templates = lift(setup.enrolled, strategy=plain, m=m, source=setup.source, stream=stream)
    templates = as_stored(templates)
    count = plain.decoys(m)
    feet = templates.feet / np.maximum(templates.foot_norms, 1e-12)[:, None]
    fresh, cosine = setup.fresh, setup.match_cosine
    finite = [
        Theft.of(
            "second moments",
            faces,
            likeliest_descriptors(templates, moments, setup.decoys, count=count),
            fresh,
            cosine,
        )
        for faces, moments in setup.attackers
    ]
    extrapolated = extrapolate([(theft.faces or 0, theft.found) for theft in finite])
    thefts = (Theft.of("foot point", 0, feet, fresh, cosine), *finite)
    return Privacy(strategy, m, thefts, extrapolated)


def extrapolate(found: Sequence[tuple[int, Rate]], *, to: float = np.inf) -> float | None:
    """Share of templates that ``to`` faces of the same kind would open, from other numbers.

    The logit of the share, with half a success and half a failure added, is fitted as a line in
    1/faces, every point weighed by its binomial information; the value at 1/``to`` is returned.
    None with fewer than two numbers. It is rough, and no verdict rests on it: it is there to show
    what a larger number of faces is likely to open.
    """
    if len({faces for faces, _ in found}) < 2:
        return None
    shares = np.array([(rate.errors + 0.5) / (rate.trials + 1) for _, rate in found])
    trials = np.array([rate.trials for _, rate in found])
    weights = np.sqrt(trials * shares * (1 - shares))
    design = np.array([[1.0, 1.0 / faces] for faces, _ in found])
    logits = np.log(shares / (1 - shares))
    line = np.linalg.lstsq(design * weights[:, None], logits * weights, rcond=None)[0]
    return float(1 / (1 + np.exp(-line[0] - line[1] / to)))


def face_counts(total: int) -> tuple[int, ...]:
    """Numbers of faces that attackers have, up to all that there are."""
    return (*(count for count in FACE_COUNTS if count < _FEWER * total), total)


def decoy_moments(source: DecoySource, *, draws: int = DRAWS, seed: int) -> Moments:
    """Second moments of what anybody can draw from the client's generator of a source."""
    with Keystream.seeded("privacy", seed, "decoys that the attacker draws") as stream:
        drawn = client_source(source).draw(draws, 1, stream=stream)[:, 0, :]
    return Moments.of(second_moment(drawn))


def as_stored(templates: SubspaceBatch) -> SubspaceBatch:
    """Round to half precision, as the wire format does."""
    return SubspaceBatch(
        templates.feet.astype(np.float16).astype(np.float32),
        templates.bases.astype(np.float16).astype(np.float32),
    )


def matches(
    guesses: NDArray[np.floating], fresh: NDArray[np.floating], match_cosine: float
) -> Rate:
    """Share of guesses (V, n) that match a fresh photo (V, n)."""
    hits = np.einsum("ij,ij->i", guesses, fresh) >= match_cosine
    return rate(int(np.count_nonzero(hits)), len(hits))
