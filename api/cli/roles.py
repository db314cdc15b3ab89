"""Who is in which role of a deployment's preparation.

Nobody may be in two: decoys adapted to the people whom a calibration measures hide those better
than they will hide a user (docs/method.md "Decoys of the people themselves"). People are told
apart by the names of their folders, which is as far as it is seen to here: somebody who is there
under two names, with other photos, is not noticed.
"""

import random
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import TypeVar

from api.cli.errors import CommandError
from api.cli.photo_folders import photos_of
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
    calibration: LabelledFolder = field(repr=False)
    left_out: int
    is_labelled: bool


def assign_roles(
    labelled: LabelledFolder, faces: Sequence[Path], like: Sequence[Path] = ()
) -> Roles:
    """Give every photo one role, where people are labelled."""
    names, left_out = frozenset(labelled.identities), 0
    sample, calibration = ([], labelled) if like else split_people(labelled)
    if like:
        sample, left_out = photos_of(like, names)
        names |= {path.parent.name for path in sample if path.parent not in like}
        if not sample:
            raise CommandError("everybody in --like is in PEOPLE too; name folders of others")
    kept, more = _others(faces, names, [*labelled.paths, *sample])
    if not kept:
        raise CommandError("everybody in --faces is in PEOPLE or --like; name folders of others")
    return Roles(kept, tuple(sample), calibration, left_out + more, is_labelled=True)


def assign_faces(faces: Sequence[Path], apart: LabelledFolder | None) -> Roles:
    """Give every photo one role, where each is taken for a person of its own.

    Nobody of ``apart`` is taken.
    """
    names = frozenset() if apart is None else frozenset(apart.identities)
    photos, left_out = _others(faces, names, () if apart is None else apart.paths)
    order = _shuffled(photos)
    count = min(CALIBRATED_FACES, len(order) // 2)
    if len(order) - count < MIN_DESCRIPTORS:
        raise CommandError(
            f"--faces has {len(photos)} photos: half of them set the thresholds, and decoys "
            f"are fitted to the other half, which takes {MIN_DESCRIPTORS}: give "
            f"{2 * MIN_DESCRIPTORS} or more, better 5,000"
        )
    alone = sorted(order[:count])
    calibration = LabelledFolder(faces[0], tuple(alone), tuple(map(str, alone)), ())
    return Roles(tuple(sorted(order[count:])), (), calibration, left_out, is_labelled=False)


def _others(
    folders: Sequence[Path], names: frozenset[str], taken: Iterable[Path]
) -> tuple[tuple[Path, ...], int]:
    """Photos of folders that are neither of these names nor taken; and how many were left out."""
    photos, left_out = photos_of(folders, names)
    files = {path.resolve() for path in taken}
    kept = tuple(path for path in photos if path.resolve() not in files)
    return kept, left_out + len(photos) - len(kept)


def split_people(labelled: LabelledFolder) -> tuple[list[Path], LabelledFolder]:
    """Part people into a sample for the decoys and those to calibrate on.

    The sample gets nobody whom the verdict needs, and where nothing else is possible, nobody whom
    the thresholds need. People with the fewest photos are in it, of equals any: the same for the
    same folder.
    """
    albums = labelled.albums
    order = sorted(_shuffled(albums), key=lambda name: len(albums[name]))
    photos_so_far = list(accumulate(len(albums[name]) for name in order))
    tries = [(photos, is_telling) for photos in SAMPLE_PHOTOS]
    for photos, suffices in [*tries, (SAMPLE_PHOTOS[-1], _has_enough_pairs)]:
        people = bisect_left(photos_so_far, photos) + 1
        rest = labelled.with_albums({name: albums[name] for name in order[people:]})
        # Decoys are adapted to so many people at least.
        if MIN_DESCRIPTORS // 2 <= people <= len(order) and suffices(rest):
            return [photo for name in sorted(order[:people]) for photo in albums[name]], rest
    return [], labelled


def _shuffled(things: Iterable[T]) -> list[T]:
    """Put things in an order of no meaning, the same for the same things."""
    order = sorted(things, key=str)
    random.Random(0).shuffle(order)
    return order


def _has_enough_pairs(labelled: LabelledFolder) -> bool:
    return sum(len(photos) > 1 for photos in labelled.albums.values()) >= LEAST_PEOPLE


def is_telling(labelled: LabelledFolder) -> bool:
    """Whether so many people can show that templates are private.

    Half of them at most are attacked: axes and dimension are chosen on one half of those, and
    judged on the other, with the faces of all who are not attacked.
    """
    people = labelled.people
    attacked = min(MOST_ATTACKED, people // 2)
    faces = len(labelled) * (people - attacked) / max(people, 1)
    return attacked >= 2 * LEAST_VICTIMS and faces >= LEAST_FACES


def sets_thresholds(people: int, photos: int) -> bool:
    """Whether so many people and photos resolve the largest false match rate that is set."""
    rate, expected = max(TARGETS), 1.5 * EXPECTED_ERRORS
    has_trials = resolvable(rate, photos * (people - 1), expected_errors=expected)
    return has_trials and resolvable(rate, people * (people - 1) // 2)
