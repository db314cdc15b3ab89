"""Decoys of the very people of a calibration are found; decoys of others never are."""

from itertools import product

import numpy as np
import pytest

from templates.decoys import DecoyGenerator, DecoyPool
from templates.errors import ContractError
from tests.verify.synthetic import People, draw_people, unit
from verify.own_decoys import require_others


def uneven(people: People, *, power: float = 0.5) -> People:
    """The same people with variances that fall along the axes, as those of faces do."""
    scale = np.arange(1, people.descriptors.shape[1] + 1) ** -power
    return People(unit(people.descriptors * scale), people.names)


def drawn(count: int, *, photos: int = 4, seed: int = 0, power: float = 0.5) -> People:
    return uneven(draw_people(count, photos=(photos,), n=128, noise=0.8, seed=seed), power=power)


def refused(source: DecoyGenerator | DecoyPool, people: People) -> str | None:
    try:
        require_others(source, people.descriptors, people.names)
    except ContractError as error:
        return str(error)
    return None


@pytest.mark.parametrize("count", [30, 100, 500])
def test_a_generator_of_these_people_is_refused(count: int) -> None:
    people = drawn(count)
    said = refused(DecoyGenerator.fit(people.descriptors), people)
    assert said is not None
    assert "made of the photos of these people" in said
    assert "Build the decoys from other people's photos" in said


@pytest.mark.parametrize("count", [100, 500, 2000])
def test_a_generator_of_others_is_not(count: int) -> None:
    """Of the same kind and of others, small and large sets, fewer faces than dimensions too."""
    source = DecoyGenerator.fit(drawn(count, photos=1, seed=1).descriptors)
    for calibrated, power in product((20, 80, 300), (0.3, 0.5, 0.6)):
        people = drawn(calibrated, seed=2, power=power)
        assert refused(source, people) is None, (calibrated, power)


def test_a_pool_that_holds_the_people_is_refused_by_other_photos_of_them_too() -> None:
    people = drawn(100, photos=2)
    entries, probes = people.descriptors[::2], People(people.descriptors[1::2], people.names[1::2])
    assert "the decoy pool seems to hold" in str(refused(DecoyPool(entries), probes))
    others = drawn(400, seed=5).descriptors
    assert refused(DecoyPool(others), probes) is None
    assert refused(DecoyPool(np.concatenate([others, entries[:1]])), probes) is None
