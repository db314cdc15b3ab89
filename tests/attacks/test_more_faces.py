"""What more faces would change, on people whose second moments are known."""

from dataclasses import replace

import numpy as np
import pytest

from attacks.more_faces import _halves, decoys_of_these_people, more_faces, unlimited
from attacks.operating_point import judge_privacy
from attacks.privacy import AttackSetup, extrapolate, privacy_of
from templates.contract.levels import Rate
from templates.space.lifting import Strategy
from tests.attacks.test_privacy import COSINE, FACES, OTHER, generator, rows, setup_with
from tests.verify.synthetic import unit
from verify.metrics import rate

M = 8


def test_unlimited_faces_tell_more_than_few_and_hardly_more_than_many() -> None:
    setup = setup_with(OTHER)
    measured = privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=M).strongest.found
    estimate = unlimited(setup, strategy=Strategy.ADVERSARIAL, m=M)
    assert estimate.faces is None
    assert estimate.found.value == pytest.approx(measured.value, abs=0.1)
    assert estimate.control.value < 0.05


def test_decoys_of_the_kind_are_measured_and_more_of_them_hide_more() -> None:
    told = decoys_of_these_people(setup_with(OTHER), strategy=Strategy.ADVERSARIAL, m=M)
    measured = told["decoys_of_these_people"]
    assert [row["decoy_faces"] for row in measured] == [187, 375, 750]
    assert {row["thief_faces"] for row in measured} == {750}
    found = [Rate.from_json(row["found"]) for row in measured]
    strange = privacy_of(setup_with(OTHER), strategy=Strategy.ADVERSARIAL, m=M).strongest
    assert strange.found.value > found[0].value + 0.3
    assert told["twice_the_decoy_faces"] == extrapolate(
        list(zip((187, 375, 750), found, strict=True)), to=1_500
    )


def test_a_person_with_many_photos_is_the_thiefs_or_the_decoys() -> None:
    enrolled, faces = rows(20, FACES, 1), rows(300, FACES, 3)
    owners = np.repeat(np.arange(30), [10] * 30)
    setup = AttackSetup.of(
        enrolled,
        enrolled,
        faces,
        generator(tuple(OTHER)),
        match_cosine=COSINE,
        owners=owners,
    )
    # Rows and owners are shuffled alike.
    place = {row.tobytes(): owner for row, owner in zip(faces, owners, strict=True)}
    assert [place[row.tobytes()] for row in setup.faces] == setup.owners.tolist()
    thief, others = _halves(setup)
    assert len(thief) == len(others) == 150
    people = [{place[row.tobytes()] for row in part} for part in (thief, others)]
    assert not people[0] & people[1]
    assert [len(part) for part in people] == [15, 15]


def test_a_person_with_most_photos_leaves_the_halves_even() -> None:
    enrolled, faces = rows(20, FACES, 1), rows(300, FACES, 3)
    owners = np.concatenate([np.zeros(140, dtype=int), np.arange(1, 161)])
    for seed in range(5):
        setup = AttackSetup.of(
            enrolled,
            enrolled,
            faces,
            generator(tuple(OTHER)),
            match_cosine=COSINE,
            owners=owners,
            seed=seed,
        )
        thief, others = _halves(setup)
        assert (len(thief), len(others)) == (150, 150)


def test_too_few_faces_for_a_fit_say_nothing() -> None:
    enrolled = rows(20, FACES, 1)
    fresh = unit(enrolled + 0.6 * rows(20, FACES, 2))
    setup = AttackSetup.of(
        enrolled, fresh, rows(150, FACES, 3), generator(tuple(OTHER)), match_cosine=COSINE
    )
    assert decoys_of_these_people(setup, strategy=Strategy.ADVERSARIAL, m=M) == {}


def test_it_is_told_where_the_verdict_is_close_and_shows_something() -> None:
    setup = setup_with(OTHER)
    judgement = judge_privacy(privacy_of(setup, strategy=Strategy.ADVERSARIAL, m=M))
    assert judgement.close
    told = more_faces(setup, judgement, strategy=Strategy.ADVERSARIAL, m=M)
    assert set(told) == {"unlimited", "decoys_of_these_people", "twice_the_decoy_faces"}
    # A contract holds it.
    assert replace(judgement, basis={**judgement.basis, **told}).basis["unlimited"]
    few = replace(judgement, shortfall="so few")
    assert more_faces(setup, few, strategy=Strategy.ADVERSARIAL, m=M) == {}
    far = replace(judgement, rate=rate(1, 100), limit=0.05)
    assert not far.close
    assert more_faces(setup, far, strategy=Strategy.ADVERSARIAL, m=M) == {}


def test_extrapolation_reaches_a_number_between() -> None:
    points = [(1_000, rate(400, 1_000)), (2_000, rate(200, 1_000))]
    values = [extrapolate(points, to=to) for to in (1_000, 2_000, 4_000, np.inf)]
    assert values[0] == pytest.approx(0.4, abs=0.001)
    assert values[1] == pytest.approx(0.2, abs=0.001)
    assert values[0] > values[1] > values[2] > values[3] > 0
