"""Who is in which role, and what so many people can show."""

from pathlib import Path

import pytest

from api.cli.roles import is_telling, sets_thresholds, split_people
from verify import LabelledFolder


def people_with(*counts: tuple[int, int]) -> LabelledFolder:
    """People as (how many, with how many photos each)."""
    photos = [
        Path(f"{kind}-{person}") / f"{photo}.jpg"
        for kind, (people, each) in enumerate(counts)
        for person in range(people)
        for photo in range(each)
    ]
    return LabelledFolder(Path(), tuple(photos), tuple(path.parent.name for path in photos), ())


@pytest.mark.parametrize(
    ("counts", "sample", "people_left"),
    [
        (((80, 5),), 0, 80),  # the thresholds need all
        (((140, 5),), 300, 80),  # 60 people have 300 photos, and 80 are left
        (((139, 5),), 0, 139),
        (((3_000, 1), (300, 4)), 1_200, 2_100),  # people with one photo come first
        (((400, 4),), 300, 325),  # the verdict would need all, the thresholds do not
        (((45, 7), (100, 8)), 0, 145),  # decoys are adapted to 50 people or more
    ],
)
def test_the_sample_gets_nobody_whom_the_calibration_needs(
    counts: tuple[tuple[int, int], ...], sample: int, people_left: int
) -> None:
    people = people_with(*counts)
    photos, calibration = split_people(people)
    assert (len(photos), calibration.people) == (sample, people_left)
    assert {*photos, *calibration.paths} == {*people.paths}
    assert not {photo.parent.name for photo in photos} & {*calibration.identities}


@pytest.mark.parametrize(
    ("people", "photos", "sets"),
    [
        (24, 1_200, False),  # 276 pairs of people, and a rate of 1 in 100 takes 300
        (25, 1_250, True),
        (45, 45, True),  # nobody needs a second photo
        (25, 60, False),  # 1,440 trials, and half as many again as 1,000 are asked for
    ],
)
def test_so_many_people_set_a_threshold(people: int, photos: int, sets: bool) -> None:
    assert sets_thresholds(people, photos) is sets


@pytest.mark.parametrize(
    ("counts", "telling"),
    [(((200, 5),), False), (((1_000, 1), (150, 4)), False), (((1_000, 1), (300, 4)), True)],
)
def test_so_many_people_can_show_that_templates_are_private(
    counts: tuple[tuple[int, int], ...], telling: bool
) -> None:
    assert is_telling(people_with(*counts)) is telling
