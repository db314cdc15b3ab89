"""Who is in which role of a deployment's preparation, and what so many people can show.

Nobody may be in two: decoys adapted to the people whom a calibration measures hide those better
than they will hide a user (docs/method.md "Decoys of the people themselves"). People are told
apart by the names of their folders, which is as far as it is seen to here: somebody who is there
under two names, with other photos, is not noticed.
"""

import random
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import TypeVar

from api.cli.decoys import photos_of
from api.cli.errors import CommandError
from attacks.bed import LEAST_FACES, LEAST_VICTIMS
from attacks.setup import MOST_ATTACKED
from templates.decoys.fitting import FACES_PER_DIMENSION, MIN_DESCRIPTORS
from verify import LabelledFolder
from verify.metrics import resolvable
from verify.thresholds import EXPECTED_ERRORS, TARGETS

SAMPLE_PHOTOS = (2_400, 1_200, 600, 300)
"""Photos to adapt decoys to, the best first: with more of them fewer templates give a face away."""
CALIBRATED_FACES = 2_400
"""Most faces that nobody labelled which thresholds and privacy are measured on, and half of all at
most. Decoys are fitted to the others."""
LEAST_PEOPLE = 80
"""With three photos each or more: as many resolve a false match rate of 1 in 1,000."""
FEWEST_PEOPLE = 25
"""With three photos each or more: as many resolve a false match rate of 1 in 100."""

Albums = Mapping[str, Sequence[Path]]
T = TypeVar("T")


@dataclass(frozen=True)
class Roles:
    """Photos by role; the name of a person is in one of the three.

    Parameters
    ----------
    faces
        Photos of anybody, that decoys are fitted to.
    sample
        Photos of the kind that will be enrolled, that decoys are adapted to; none where there are
        too few.
    calibration
        Photos by person, that thresholds and the verdict are measured on.
    left_out
        Photos of the other roles that are named like people of the calibration or the sample.
    """

    faces: tuple[Path, ...] = field(repr=False)
    sample: tuple[Path, ...] = field(repr=False)
    calibration: Albums = field(repr=False)
    left_out: int = 0

    @property
    def photos(self) -> int:
        """Number of photos of the calibration."""
        return sum(map(len, self.calibration.values()))


def assign_roles(
    labelled: LabelledFolder | None,
    faces: Sequence[Path],
    like: Sequence[Path],
    *,
    apart: LabelledFolder | None = None,
) -> Roles:
    """Give every photo one role; people are told apart by the names of their folders.

    Without ``labelled`` each of the faces is a person of its own; nobody of ``apart`` is taken.

    Raises
    ------
    CommandError
        No face is left to fit decoys to, or no photo of ``like``.
    """
    if labelled is None:
        aside = frozenset() if apart is None else frozenset(apart.identities)
        others, left_out = photos_of(faces, aside)
        taken = frozenset() if apart is None else {path.resolve() for path in apart.paths}
        kept, calibration = split_faces([path for path in others if path.resolve() not in taken])
        if len(kept) < MIN_DESCRIPTORS:
            raise CommandError(
                f"--faces has {len(others)} photos: half of them set the thresholds, and decoys "
                f"are fitted to the other half, which takes {MIN_DESCRIPTORS}: give "
                f"{2 * MIN_DESCRIPTORS} or more, better 5,000"
            )
        return Roles(kept, (), calibration, left_out)
    albums: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        albums.setdefault(name, []).append(path)
    names, left_out = frozenset(albums), 0
    sample: Sequence[Path]
    if like:
        sample, left_out = photos_of(like, names)
        calibration = albums
        names |= {path.parent.name for path in sample if path.parent not in like}
        if not sample:
            raise CommandError("everybody in --like is in PEOPLE too; name folders of others")
    else:
        sample, calibration = split_people(albums)
    others, more = photos_of(faces, names)
    taken = {path.resolve() for path in (*labelled.paths, *sample)}
    kept = tuple(path for path in others if path.resolve() not in taken)
    if not kept:
        raise CommandError("everybody in --faces is in PEOPLE or --like; name folders of others")
    return Roles(kept, tuple(sample), calibration, left_out + more + len(others) - len(kept))


def split_people(albums: Albums) -> tuple[tuple[Path, ...], Albums]:
    """Part people into a sample for the decoys and those to calibrate on.

    The sample gets nobody whom the verdict needs, and where nothing else is possible, nobody whom
    the thresholds need. People with the fewest photos are in it, of equals any: the same for the
    same folder.
    """
    order = sorted(_shuffled(albums), key=lambda name: len(albums[name]))
    photos_so_far = list(accumulate(len(albums[name]) for name in order))
    tries = [(photos, is_telling) for photos in SAMPLE_PHOTOS]
    for photos, suffices in [*tries, (SAMPLE_PHOTOS[-1], _sets_thresholds)]:
        people = bisect_left(photos_so_far, photos) + 1
        rest = {name: albums[name] for name in order[people:]}
        # Decoys are adapted to so many people at least.
        if MIN_DESCRIPTORS // 2 <= people <= len(order) and suffices(rest):
            return tuple(photo for name in sorted(order[:people]) for photo in albums[name]), rest
    return (), albums


def split_faces(faces: Sequence[Path]) -> tuple[tuple[Path, ...], Albums]:
    """Part faces that nobody labelled: those for decoys, and those to calibrate on.

    Each is taken for a person of its own.
    """
    order = _shuffled(faces)
    count = min(CALIBRATED_FACES, len(order) // 2)
    return tuple(sorted(order[count:])), {str(path): (path,) for path in sorted(order[:count])}


def _shuffled(things: Iterable[T]) -> list[T]:
    """Put things in an order of no meaning, the same for the same things."""
    order = sorted(things, key=str)
    random.Random(0).shuffle(order)
    return order


def _sets_thresholds(albums: Albums) -> bool:
    return with_several(albums) >= LEAST_PEOPLE


def with_several(albums: Albums) -> int:
    """Number of people with two photos or more."""
    return sum(len(photos) > 1 for photos in albums.values())


def attacked_and_others(albums: Albums) -> tuple[int, int]:
    """How many people the privacy of a calibration is measured on, and photos of all the others.

    The second is what is to be expected: who is attacked is drawn.
    """
    several, total = with_several(albums), sum(map(len, albums.values()))
    attacked = min(MOST_ATTACKED, len(albums) // 2)
    if several:
        attacked = min(attacked, max(several, 2 * LEAST_VICTIMS))
    of_several = sum(len(photos) for photos in albums.values() if len(photos) > 1)
    shown = min(attacked, several)
    return attacked, total - (of_several * shown // max(several, 1)) - (attacked - shown)


def is_telling(albums: Albums) -> bool:
    """Whether so many people can show that templates are private.

    Axes and dimension are chosen on one half of those attacked, and judged on the other.
    """
    attacked, others = attacked_and_others(albums)
    return attacked >= 2 * LEAST_VICTIMS and others >= LEAST_FACES


def resolved_rates(albums: Albums) -> list[float]:
    """False match rates that so many people and photos resolve, the largest first."""
    people, photos = len(albums), sum(map(len, albums.values()))
    return [
        target
        for target in sorted(TARGETS, reverse=True)
        if resolvable(target, photos * (people - 1), expected_errors=1.5 * EXPECTED_ERRORS)
        and resolvable(target, people * (people - 1) // 2)
    ]


def too_few(albums: Albums) -> str:
    """Say that so few people set no threshold, and how many would."""
    return (
        f"{len(albums)} people with {sum(map(len, albums.values()))} photos are too few to set a "
        f"threshold by: {FEWEST_PEOPLE} resolve that 1 stranger in 100 is accepted, and "
        f"{LEAST_PEOPLE} that 1 in 1,000 is"
    )


def promises(roles: Roles, *, n: int) -> tuple[list[str], list[str]]:
    """Say what can and what cannot be promised with so many photos, in sentences.

    Parameters
    ----------
    n
        Numbers of an embedding.
    """
    can, cannot = [], []
    people = roles.calibration
    rates = resolved_rates(people)
    if rates:
        levels = ", ".join(f"1 in {1 / rate:,.0f}" for rate in rates)
        can.append(f"thresholds for false match rates of {levels}")
    else:
        cannot.append(
            f"any false match rate: {len(people)} people are too few, {FEWEST_PEOPLE} resolve 1 in "
            f"100, and {LEAST_PEOPLE} 1 in 1,000"
        )
    if not with_several(people):
        cannot.append("how many genuine photos are rejected: nobody is labelled with two photos")
    if rates and rates[-1] > 1e-3:
        cannot.append(f"a false match rate of 1 in 1,000: that takes {LEAST_PEOPLE} people")
    attacked, others = attacked_and_others(people)
    if is_telling(people):
        can.append(f"a verdict on privacy, by attacks on {attacked} people")
    else:
        cannot.append(
            f"that templates are private: {attacked} people can be attacked, with {others:,} faces "
            f"of the others, and a PASS takes {2 * LEAST_VICTIMS} with {LEAST_FACES:,}"
        )
    if roles.sample:
        can.append(f"decoys like your people, by {len(roles.sample):,} photos of them")
    else:
        cannot.append(
            "decoys like your people: that takes photos of others of their kind, better 600 or "
            "more (--like)"
        )
    if len(roles.faces) < FACES_PER_DIMENSION * n:
        cannot.append(
            f"that the decoys give nobody of {len(roles.faces):,} faces away: that takes "
            f"{FACES_PER_DIMENSION * n:,}"
        )
    return can, cannot
