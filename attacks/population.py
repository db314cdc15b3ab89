"""The disjoint groups of people that an audit of templates needs.

An audit needs people with two photos or more: victims, whose fresh photo tells whether an attack
succeeded; and decoy owners, who try to log in where they are a decoy. The others calibrate, or
belong to the attacker. Nobody is in two groups.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from attacks.errors import AuditError
from templates.decoys import DecoySource
from templates.space.embedding import normalised, unit_descriptors

ENROLLED_PHOTOS = 3
"""Most photos that are averaged into a victim's template."""
LEAST_ALBUM = 3
LEAST_FITTED = 100
"""Least that a decoy generator is fitted to."""
LEAST_CALIBRATION = 200


@dataclass(frozen=True, eq=False, repr=False)
class Subjects:
    """Two descriptors of each of some people, rows in one order.

    Parameters
    ----------
    enrolled : (P, n) float32
        What is lifted: the mean of some photos, renormalised.
    fresh : (P, n) float32
        A photo that is not among them.
    photos : (P,) int64
        Number of photos in ``enrolled``.
    shown : (P,) int64
        Row of the folder's descriptors that is one of them.
    """

    enrolled: NDArray[np.float32]
    fresh: NDArray[np.float32]
    photos: NDArray[np.int64]
    shown: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.enrolled)

    def first(self, count: int) -> "Subjects":
        """Return the first of them."""
        return Subjects(
            self.enrolled[:count], self.fresh[:count], self.photos[:count], self.shown[:count]
        )

    def along(self, source: DecoySource) -> "Subjects":
        """Take the embeddings to the coordinates that templates have."""
        return replace(
            self, enrolled=source.project(self.enrolled), fresh=source.project(self.fresh)
        )


@dataclass(frozen=True, eq=False, repr=False)
class Population:
    """The groups.

    Parameters
    ----------
    owners
        Their ``enrolled`` descriptor, of one photo, makes up the pool of real decoys; ``fresh`` is
        the photo that they come to log in with.
    attacker : (A, n) float32
        One photo of each of the people whom the attacker has faces of.
    calibration : (C, n) float32
        All photos of the people who calibrate.
    names
        Their C names.
    known : (B, n) float32
        All photos of everybody but victims and owners: what a strong attacker has.
    known_names
        Their B names.
    albums
        Embeddings of all photos, (k, n), of each victim who has three or more.
    """

    victims: Subjects
    owners: Subjects
    attacker: NDArray[np.float32]
    calibration: NDArray[np.float32]
    names: tuple[str, ...]
    known: NDArray[np.float32]
    known_names: tuple[str, ...]
    albums: tuple[NDArray[np.float32], ...]


def draw_population(
    descriptors: NDArray[np.float32],
    identities: Sequence[str],
    *,
    victims: int,
    owners: int,
    seed: int,
) -> Population:
    """Divide the people of a labelled folder into groups, at random.

    Parameters
    ----------
    descriptors : (N, n) floating
        Unit rows.
    victims, owners
        How many; of people with two photos or more. Of the people who are left a third belong to
        the attacker and the others calibrate.

    Raises
    ------
    AuditError
        There are too few people, or too few with two photos.
    """
    rows = unit_descriptors(descriptors)
    people, person_of = np.unique(np.asarray(identities, dtype=np.str_), return_inverse=True)
    if len(person_of) != len(rows):
        raise AuditError(f"{len(identities)} names do not fit {len(rows)} embeddings")
    rng = np.random.default_rng(seed)
    photos = np.split(np.argsort(person_of, kind="stable"), np.bincount(person_of).cumsum()[:-1])
    several = rng.permutation([i for i, photo_rows in enumerate(photos) if len(photo_rows) > 1])
    if len(several) < victims + owners:
        raise AuditError(
            f"{victims} victims and {owners} decoy owners need {victims + owners} people with two "
            f"photos or more, and {len(several)} are there: ask for fewer people "
            "(victims, owners), or give a larger folder"
        )
    attacked, owning = several[:victims], several[victims : victims + owners]
    others = rng.permutation(np.setdiff1d(np.arange(len(people)), several[: victims + owners]))
    known = others[: len(others) // 3]
    calibrating = others[len(known) :]
    if len(calibrating) < LEAST_CALIBRATION:
        raise AuditError(
            f"{len(calibrating)} people are left to calibrate on, and {LEAST_CALIBRATION} are the "
            "least: ask for fewer people (victims, owners), or give a larger folder"
        )
    chosen = np.concatenate([photos[person] for person in calibrating])
    others_photos = np.concatenate([photos[person] for person in others])
    return Population(
        victims=_people(rows, [rng.permutation(photos[i]) for i in attacked], ENROLLED_PHOTOS),
        owners=_people(rows, [rng.permutation(photos[i]) for i in owning], 1),
        attacker=rows[[rng.choice(photos[i]) for i in known]].astype(np.float32),
        calibration=rows[chosen].astype(np.float32),
        names=tuple(str(people[person]) for person in person_of[chosen]),
        known=rows[others_photos].astype(np.float32),
        known_names=tuple(str(people[person]) for person in person_of[others_photos]),
        albums=tuple(
            rows[photos[i]].astype(np.float32) for i in attacked if len(photos[i]) >= LEAST_ALBUM
        ),
    )


def without_decoy_people(
    population: Population, *, seed: int
) -> tuple[NDArray[np.float32], Population]:
    """Set half of the calibrating people aside, and the decoy owners, to fit decoys to.

    Returns
    -------
    descriptors : (D, n) float32
        Their photos.
    population
        Without them among those who calibrate.
    """
    people = np.random.default_rng([seed, 1]).permutation(np.unique(population.names))
    fitted, also = (
        np.isin(names, people[: len(people) // 2])
        for names in (population.names, population.known_names)
    )
    kept = replace(
        population,
        calibration=population.calibration[~fitted],
        names=tuple(np.asarray(population.names)[~fitted].tolist()),
        known=population.known[~also],
        known_names=tuple(np.asarray(population.known_names)[~also].tolist()),
    )
    return np.concatenate(
        [population.calibration[fitted], population.owners.enrolled, population.owners.fresh]
    ), kept


def _people(rows: NDArray[np.float64], photos: Sequence[NDArray[np.int64]], most: int) -> Subjects:
    taken = [photo_rows[: min(most, len(photo_rows) - 1)] for photo_rows in photos]
    means = np.array([rows[photo_rows].mean(axis=0) for photo_rows in taken])
    means = means.reshape(-1, rows.shape[1])  # of nobody too
    return Subjects(
        enrolled=normalised(means).astype(np.float32),
        fresh=rows[np.array([photo_rows[-1] for photo_rows in photos], dtype=np.int64)].astype(
            np.float32
        ),
        photos=np.array([len(photo_rows) for photo_rows in taken], dtype=np.int64),
        shown=np.array([photo_rows[0] for photo_rows in taken], dtype=np.int64),
    )
