"""Who is in which role of a deployment's preparation.

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
from templates.decoys.fitting import MIN_DESCRIPTORS
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

    Decoys are fitted to ``faces`` and adapted to ``sample``, which is of the kind that will be
    enrolled, and may be empty. Thresholds and verdict are measured on ``calibration``. ``left_out``
    counts photos of people who have another role.
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
    labelled: LabelledFolder, faces: Sequence[Path], like: Sequence[Path] = ()
) -> Roles:
    """Give every photo one role, where people are labelled."""
    albums: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        albums.setdefault(name, []).append(path)
    names, left_out = frozenset(albums), 0
    sample: Sequence[Path]
    calibration: Albums = albums
    if like:
        sample, left_out = photos_of(like, names)
        names |= {path.parent.name for path in sample if path.parent not in like}
        if not sample:
            raise CommandError("everybody in --like is in PEOPLE too; name folders of others")
    else:
        sample, calibration = split_people(albums)
    kept, more = _others(faces, names, [*labelled.paths, *sample])
    if not kept:
        raise CommandError("everybody in --faces is in PEOPLE or --like; name folders of others")
    return Roles(kept, tuple(sample), calibration, left_out + more)


def assign_faces(faces: Sequence[Path], apart: LabelledFolder | None) -> Roles:
    """Give every photo one role, where each is taken for a person of its own.

    Nobody of ``apart`` is taken.
    """
    names = frozenset() if apart is None else frozenset(apart.identities)
    photos, left_out = _others(faces, names, () if apart is None else apart.paths)
    kept, calibration = split_faces(photos)
    if len(kept) < MIN_DESCRIPTORS:
        raise CommandError(
            f"--faces has {len(photos)} photos: half of them set the thresholds, and decoys "
            f"are fitted to the other half, which takes {MIN_DESCRIPTORS}: give "
            f"{2 * MIN_DESCRIPTORS} or more, better 5,000"
        )
    return Roles(kept, (), calibration, left_out)


def _others(
    folders: Sequence[Path], names: frozenset[str], taken: Iterable[Path]
) -> tuple[tuple[Path, ...], int]:
    """Photos of folders that are neither of these names nor taken; and how many were left out."""
    photos, left_out = photos_of(folders, names)
    files = {path.resolve() for path in taken}
    kept = tuple(path for path in photos if path.resolve() not in files)
    return kept, left_out + len(photos) - len(kept)


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
    """Part faces that nobody labelled into those for decoys and those to calibrate on."""
    order = _shuffled(faces)
    count = min(CALIBRATED_FACES, len(order) // 2)
    return tuple(sorted(order[count:])), {str(path): (path,) for path in sorted(order[:count])}


def _shuffled(things: Iterable[T]) -> list[T]:
    """Put things in an order of no meaning, the same for the same things."""
    order = sorted(things, key=str)
    random.Random(0).shuffle(order)
    return order


def _with_several(albums: Albums) -> int:
    return sum(len(photos) > 1 for photos in albums.values())


def _sets_thresholds(albums: Albums) -> bool:
    return _with_several(albums) >= LEAST_PEOPLE


def is_telling(albums: Albums) -> bool:
    """Whether so many people can show that templates are private.

    Axes and dimension are chosen on one half of those attacked, and judged on the other, with the
    faces of all others. The people attacked are drawn at random, so the expected number of their
    photos is used.
    """
    several, total = _with_several(albums), sum(map(len, albums.values()))
    attacked = min(MOST_ATTACKED, len(albums) // 2)
    if several:
        attacked = min(attacked, max(several, 2 * LEAST_VICTIMS))
    of_several = sum(len(photos) for photos in albums.values() if len(photos) > 1)
    shown = min(attacked, several)
    others = total - (of_several * shown // max(several, 1)) - (attacked - shown)
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
