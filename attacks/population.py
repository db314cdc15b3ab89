"""The disjoint groups of people that an audit of templates needs.

An audit needs people with two photos or more: victims, whose fresh photo tells whether an attack
succeeded; and decoy owners, who try to log in where they are a decoy. Thresholds are set on the
others, whose photos the attacker has. Nobody is in two groups.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Pairs
from attacks.outcomes import AuditError
from templates.space.embedding import normalised, unit_descriptors

ENROLLED_PHOTOS = 3
"""Most photos that are averaged into a victim's template."""
LEAST_ALBUM = 3
LEAST_OTHERS = 200

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class Population:
    """The groups.

    Parameters
    ----------
    owners
        Their ``enrolled`` embedding, of one photo, makes up the pool of real decoys; ``fresh`` is
        the photo that they come to log in with.
    others : (A, n) float32
        All photos of everybody else: thresholds are set on them, and the attacker has them.
    names
        Their A names.
    albums
        Embeddings of all photos, (i, n), of each victim with three or more.
    """

    victims: Pairs
    owners: Pairs
    others: Array
    names: tuple[str, ...]
    albums: tuple[Array, ...]


def draw_population(
    embeddings: Array, identities: Sequence[str], *, victims: int, owners: int, seed: int
) -> Population:
    """Divide the people of a labelled folder, (N, n) unit rows, into groups at random.

    ``victims`` and ``owners`` are how many, of people with two photos or more.

    Raises
    ------
    AuditError
        There are too few people, or too few with two photos.
    """
    rows = unit_descriptors(embeddings)
    people, person_of = np.unique(np.asarray(identities, dtype=np.str_), return_inverse=True)
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
    if len(others) < LEAST_OTHERS:
        raise AuditError(
            f"{len(others)} people are left to calibrate on, and {LEAST_OTHERS} are the "
            "least: ask for fewer people (victims, owners), or give a larger folder"
        )
    chosen = np.concatenate([photos[person] for person in others])
    return Population(
        victims=_pairs(rows, [rng.permutation(photos[i]) for i in attacked], ENROLLED_PHOTOS),
        owners=_pairs(rows, [rng.permutation(photos[i]) for i in owning], 1),
        others=rows[chosen].astype(np.float32),
        names=tuple(str(people[person]) for person in person_of[chosen]),
        albums=tuple(
            rows[photos[i]].astype(np.float32) for i in attacked if len(photos[i]) >= LEAST_ALBUM
        ),
    )


def _pairs(rows: NDArray[np.float64], photos: Sequence[NDArray[np.int64]], most: int) -> Pairs:
    taken = [photo_rows[: min(most, len(photo_rows) - 1)] for photo_rows in photos]
    means = np.array([rows[photo_rows].mean(axis=0) for photo_rows in taken])
    means = means.reshape(-1, rows.shape[1])  # of nobody too
    fresh = rows[np.array([photo_rows[-1] for photo_rows in photos], dtype=np.int64)]
    return Pairs(normalised(means).astype(np.float32), fresh.astype(np.float32))
