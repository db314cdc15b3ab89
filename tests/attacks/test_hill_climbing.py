import numpy as np
import pytest

from attacks.errors import AuditError
from attacks.hill_climbing import Prior, _answers, climb, climb_victims, learn_prior
from attacks.outcomes import Knowledge
from attacks.system import System
from tests.verify.synthetic import unit


@pytest.fixture(scope="module")
def prior(system: System) -> Prior:
    own = system.lift(system.attacker[-50:], "rehearsal of a test")
    return learn_prior(system.attacker[:-50], own)


def test_answers_are_the_service_s(system: System) -> None:
    ask = _answers(system, 3)
    (accepted, score), (other, _) = (ask(system.victims.fresh[row]) for row in (3, 4))
    foot, basis = system.templates.feet[3], system.templates.bases[3]
    e = system.victims.fresh[3].astype(float)
    expected = e @ foot + system.templates.radii[3] * np.linalg.norm(basis @ e)
    assert score == pytest.approx(expected, abs=1e-4)
    assert (accepted, other) == (True, False)


def test_scores_lead_to_acceptance(system: System) -> None:
    rows = climb_victims(system.first(8), most_attempts=200, seed=0)
    assert [row.details["limit"] for row in rows] == [5, 50, 200]
    assert rows[-1].measured.errors >= 7
    assert [row.measured.errors for row in rows] == sorted(row.measured.errors for row in rows)
    assert rows[0].knowledge is Knowledge.RIGHT
    fmr = system.level.target_fmr
    assert fmr is not None
    assert rows[0].chance == pytest.approx(1 - (1 - fmr) ** 5)
    again = climb_victims(system.first(8), most_attempts=200, seed=0)
    assert [row.measured for row in again] == [row.measured for row in rows]


def test_scores_that_are_noise_lead_nowhere(system: System, prior: Prior) -> None:
    """The decisions are the service's; the scores that come with them are drawn."""
    rng = np.random.default_rng(7)
    reached = []
    for victim in range(12):
        real = _answers(system, victim)
        reached.append(
            climb(
                lambda probe, real=real: (real(probe)[0], float(rng.normal())),
                prior,
                system.attacker[0],
                most=40,
                seed=victim,
            )
        )
    assert np.isfinite(reached).sum() <= 3


def test_a_climb_ends_at_what_is_accepted_and_at_its_last_attempt(prior: Prior) -> None:
    asked: list[np.ndarray] = []

    def seventh(probe: np.ndarray) -> tuple[bool, float]:
        assert np.linalg.norm(probe) == pytest.approx(1.0, abs=1e-5)
        asked.append(probe)
        return len(asked) == 7, float(probe[0])

    start = unit(np.ones(len(prior.mean)))
    assert climb(seventh, prior, start, most=23, seed=0) == 7
    assert climb(seventh, prior, start, most=23, seed=0) == np.inf
    assert len(asked) == 30


def test_too_few_faces_are_refused(system: System) -> None:
    from dataclasses import replace

    with pytest.raises(AuditError, match="four people"):
        climb_victims(replace(system, attacker=system.attacker[:3]), most_attempts=5, seed=0)
