"""The walk along the border of what a template accepts, and where it leads nowhere."""

from typing import Any

import numpy as np
import pytest

from attacks import decision_walk
from attacks.decision_walk import FOOT, LIKELIEST, Walk, reconstruct_from_decisions
from attacks.outcomes import AttackOutcome, Knowledge, Property
from attacks.system import System
from tests.attacks.stored.systems import count

COUNTS = (500, 4_000)
SOME = 12


def by_variant(outcomes: list[AttackOutcome]) -> dict[str, AttackOutcome]:
    return {each.variant: each for each in outcomes}


@pytest.fixture(scope="module")
def weak(weak_system: System) -> dict[str, AttackOutcome]:
    return by_variant(reconstruct_from_decisions(weak_system.first(SOME), counts=COUNTS))


def test_decisions_give_a_face_away_that_next_to_nothing_hides(
    weak: dict[str, AttackOutcome],
) -> None:
    few, many = (weak[f"{FOOT}, {count} questions"] for count in COUNTS)
    assert many.measured.value >= 0.75
    assert few.measured.value < many.measured.value
    assert count(many.details["accepted"])[0] >= 0.75 * SOME
    assert (many.breaks, many.knowledge) == (Property.IRREVERSIBILITY, Knowledge.RIGHT)
    assert many.judged


def test_the_guesses_match_nobody_else(weak: dict[str, AttackOutcome]) -> None:
    control = weak[f"{FOOT}, {COUNTS[-1]} questions, photos of other people"]
    assert control.measured.value <= 1 / SOME
    assert not control.judged


def test_answers_by_lot_give_nothing_away(
    weak_system: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(5)

    def by_lot(probes: np.ndarray, templates: Any, *_: Any, **__: Any) -> np.ndarray:
        return rng.random((len(probes), len(templates))) < 0.5

    monkeypatch.setattr(
        decision_walk._Questions, "_answer", lambda _, probes: by_lot(probes, [0])[:, 0]
    )
    found = by_variant(reconstruct_from_decisions(weak_system.first(SOME), counts=COUNTS))
    assert found[f"{FOOT}, {COUNTS[-1]} questions"].measured.value <= 1 / SOME


def test_decoys_hide_the_face_from_whoever_sees_decisions(
    system: System, weak: dict[str, AttackOutcome]
) -> None:
    found = by_variant(reconstruct_from_decisions(system.first(SOME), counts=COUNTS))
    for kind in (FOOT, LIKELIEST):
        hidden = found[f"{kind}, {COUNTS[-1]} questions"].measured.value
        assert hidden <= 3 / SOME < weak[f"{FOOT}, {COUNTS[-1]} questions"].measured.value


def test_a_lockout_ends_the_search_for_the_first_accepted_probe_only(
    weak: dict[str, AttackOutcome],
) -> None:
    rows = [weak[f"{FOOT}, 4000 questions, lockout after {limit} failures"] for limit in (5, 50)]
    free = weak[f"{FOOT}, 4000 questions"]
    assert rows[0].measured.value <= rows[1].measured.value <= free.measured.value
    assert free.measured.value > 0
    for row in rows:
        # It goes on after the first accept: what is lost is lost before it.
        lost = SOME - int(str(row.details["found_an_accepted_probe"]))
        assert row.measured.errors >= free.measured.errors - lost
        assert row.measured.value <= int(str(row.details["found_an_accepted_probe"])) / SOME


def test_an_accepted_probe_is_sent_again_before_the_last_failure() -> None:
    answers = [False, False, True, *[False] * 4, True, *[False] * 9, True, False]
    walk = Walk(3, {}, np.array(answers))
    assert [walk.repeats(limit) for limit in (2, 5, 11)] == [14, 3, 0]
    assert walk.withstands(3)
    assert not walk.withstands(2)
    assert Walk(None, {}, np.zeros(9, dtype=bool)).repeats(5) == 0


def test_no_more_is_asked_than_was_said(system: System) -> None:
    prior = decision_walk.attacker_prior(system)
    guesser = decision_walk._Guesser(system)
    for victim in range(4):
        walk = decision_walk.walk(system, victim, prior, guesser, counts=COUNTS)
        assert len(walk.answers) <= COUNTS[-1]
        if walk.first_accepted is not None:
            assert walk.answers[walk.first_accepted - 1]
            assert not walk.answers[: walk.first_accepted - 1].any()
