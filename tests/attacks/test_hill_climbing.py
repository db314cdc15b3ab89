import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.hill_climbing import (
    Answer,
    Ask,
    Climb,
    Climber,
    climb,
    climbing_outcomes,
)
from attacks.prior import Prior, attacker_prior, learn_prior
from attacks.system import System
from tests.attacks.own_decisions import in_process
from tests.verify.synthetic import unit

SCORED = (Climber.GRADIENT, Climber.REGRESSION)


@pytest.fixture(scope="module")
def prior(system: System) -> Prior:
    return attacker_prior(system)


def towards(target: np.ndarray, *, accept_at: float, score: bool = True) -> Ask:
    """A service whose template hides nothing: the score is the cosine."""

    def ask(probe: np.ndarray) -> Answer:
        cosine = float(probe @ target)
        return Answer(cosine >= accept_at, cosine if score else None)

    return ask


def test_in_process_answers_are_the_service_s(system: System) -> None:
    ask = in_process(system, [3], scores=True)[3]
    mine, other = ask(system.victims.fresh[3]), ask(system.victims.fresh[4])
    foot, basis = system.templates.feet[3], system.templates.bases[3]
    e = system.victims.fresh[3].astype(float)
    expected = e @ foot + system.templates.radii[3] * np.linalg.norm(basis @ e)
    assert mine.score == pytest.approx(expected, abs=1e-4)
    assert mine.accepted
    assert not other.accepted
    assert in_process(system, [3], scores=False)[3](system.victims.fresh[3]).score is None


@pytest.mark.parametrize("climber", SCORED)
def test_scores_lead_to_acceptance(system: System, prior: Prior, climber: Climber) -> None:
    victims = in_process(system, range(8), scores=True)
    climbs = climb(victims, prior, climber, most_attempts=200, seed=0)
    assert sum(each.accepted_at is not None for each in climbs) >= 7
    assert climbs == climb(victims, prior, climber, most_attempts=200, seed=0)


def test_regression_needs_fewer_attempts_than_a_blind_search(system: System, prior: Prior) -> None:
    victims = in_process(system, range(10), scores=True)
    reached = {
        climber: np.median(
            [
                each.accepted_at or 999
                for each in climb(victims, prior, climber, most_attempts=200, seed=0)
            ]
        )
        for climber in Climber
    }
    assert reached[Climber.REGRESSION] < reached[Climber.GRADIENT] < reached[Climber.DICTIONARY]


@pytest.mark.parametrize("climber", SCORED)
def test_scores_that_are_noise_lead_nowhere(system: System, prior: Prior, climber: Climber) -> None:
    """The decisions are the service's; the scores that come with them are drawn."""
    real = in_process(system, range(12), scores=False)
    rng = np.random.default_rng(7)

    def noisy(ask: Ask) -> Ask:
        return lambda probe: Answer(ask(probe).accepted, float(rng.normal()))

    climbs = climb(
        {number: noisy(ask) for number, ask in real.items()},
        prior,
        climber,
        most_attempts=40,
        seed=0,
    )
    assert sum(each.accepted_at is not None for each in climbs) <= 3


def test_decisions_only_find_a_service_that_accepts_a_face_of_the_dictionary(prior: Prior) -> None:
    ask = towards(prior.faces[17], accept_at=0.999, score=False)
    (only,) = climb({0: ask}, prior, Climber.DICTIONARY, most_attempts=100, seed=0)
    assert only == Climb(18, 18)


def test_an_attack_ends_at_its_last_attempt(prior: Prior) -> None:
    for climber in Climber:
        asked: list[np.ndarray] = []

        def never(probe: np.ndarray, asked: list[np.ndarray] = asked) -> Answer:
            assert np.linalg.norm(probe) == pytest.approx(1.0, abs=1e-5)
            asked.append(probe)
            return Answer(accepted=False, score=float(probe[0]))

        (only,) = climb({0: never}, prior, climber, most_attempts=23, seed=0)
        assert only == Climb(23, None)
        assert len(asked) == 23


def test_the_dictionary_opens_more_own_templates_than_its_faces_unsorted(
    system: System,
) -> None:
    templates = system.lift(system.attacker[-40:], "test of the dictionary")
    ordered = learn_prior(system.attacker, templates, rate_of_chance=0.01).faces
    assert sorted(map(tuple, ordered)) == sorted(map(tuple, system.attacker[:-40].astype(float)))

    def opened(faces: np.ndarray) -> int:
        """Templates to which one of these faces is as near as only 2 % of all pairs are."""
        e = faces.astype(float)
        inside = np.linalg.norm(np.einsum("tmn,en->etm", templates.bases, e), axis=2)
        scores = e @ templates.feet.T + templates.radii * inside
        return int((scores >= bar).any(axis=0).sum())

    everyone = system.attacker[:-40].astype(float)
    inside = np.linalg.norm(np.einsum("tmn,en->etm", templates.bases, everyone), axis=2)
    bar = np.quantile(everyone @ templates.feet.T + templates.radii * inside, 0.98)
    rng = np.random.default_rng(0)
    for first in (5, 10):
        unsorted = [opened(rng.permutation(everyone)[:first]) for _ in range(50)]
        assert opened(ordered[:first]) > max(unsorted)


def test_climbers_that_need_scores_say_so(prior: Prior) -> None:
    ask = towards(unit(np.ones(64)), accept_at=2.0, score=False)
    for climber in SCORED:
        with pytest.raises(AuditError, match="score right"):
            climb({0: ask}, prior, climber, most_attempts=5, seed=0)


def test_outcomes_count_what_a_lockout_lets_through(system: System) -> None:
    reached = [2, 5, 6, 50, 51, None]
    climbs = [Climb(at or 100, at) for at in reached]
    of_system = (system.scheme, system.level)
    rows = climbing_outcomes(Climber.REGRESSION, climbs, *of_system, most_attempts=100)
    assert [row.details["limit"] for row in rows] == [5, 50, 100]
    assert [(row.measured.errors, row.measured.trials) for row in rows] == [(2, 6), (4, 6), (5, 6)]
    fmr = system.level.target_fmr
    assert fmr is not None
    assert rows[0].chance == pytest.approx(1 - (1 - fmr) ** 5)
    assert "sends as photos" not in rows[0].assumption
    (told, *_) = climbing_outcomes(Climber.DICTIONARY, climbs, *of_system, most_attempts=100)
    assert "sends as photos, or as embeddings" in told.assumption
