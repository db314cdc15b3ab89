"""Who is in which role, and what so many people can show."""

from pathlib import Path

import pytest

from api.cli.roles import is_telling, resolved_rates, split_people


def albums(*counts: tuple[int, int]) -> dict[str, list[Path]]:
    """People as (how many, with how many photos each)."""
    named: dict[str, list[Path]] = {}
    for people, photos in counts:
        for _ in range(people):
            name = f"person-{len(named)}"
            named[name] = [Path(name) / f"{photo}.jpg" for photo in range(photos)]
    return named


@pytest.mark.parametrize(
    ("counts", "sample", "people_left"),
    [
        (((80, 5),), 0, 80),  # the thresholds need all
        (((140, 5),), 300, 80),  # 60 people have 300 photos, and 80 are left
        (((139, 5),), 0, 139),
        (((3_000, 1), (300, 4)), 1_200, 2_100),  # people with one photo come first
        (((400, 4),), 300, 325),  # the verdict would need all, the thresholds do not
    ],
)
def test_the_sample_gets_nobody_whom_the_calibration_needs(
    counts: tuple[tuple[int, int], ...], sample: int, people_left: int
) -> None:
    people = albums(*counts)
    photos, calibration = split_people(people)
    assert (len(photos), len(calibration)) == (sample, people_left)
    assert {photo.parent.name for photo in photos} | set(calibration) == set(people)
    assert not {photo.parent.name for photo in photos} & set(calibration)


def test_a_sample_of_too_few_people_is_none() -> None:
    """Decoys are adapted to 50 people or more: 45 have 300 photos."""
    people = albums((45, 7), (100, 8))
    photos, _ = split_people(people)
    assert photos == ()


@pytest.mark.parametrize(
    ("counts", "rates"),
    [
        (((24, 50),), []),  # 276 pairs of people, and a rate of 1 in 100 takes 300
        (((25, 50),), [1e-2]),
        (((77, 4),), [1e-2]),
        (((78, 4),), [1e-2, 1e-3]),
        (((5, 2), (40, 1)), [1e-2]),
        (((80, 2),), [1e-2]),  # 12,640 trials, and half as many again as 10,000 are asked for
        (((45, 1),), [1e-2]),  # nobody needs a second photo
        (((300, 1), (10, 2)), [1e-2, 1e-3]),  # pairs enough for 1e-4, but 98,880 trials
    ],
)
def test_rates_that_are_resolved(counts: tuple[tuple[int, int], ...], rates: list[float]) -> None:
    assert resolved_rates(albums(*counts)) == rates


@pytest.mark.parametrize(
    ("counts", "telling"),
    [(((200, 5),), False), (((1_000, 1), (150, 4)), False), (((1_000, 1), (200, 4)), True)],
)
def test_so_many_people_can_show_that_templates_are_private(
    counts: tuple[tuple[int, int], ...], telling: bool
) -> None:
    assert is_telling(albums(*counts)) == telling
