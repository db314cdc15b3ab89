import numpy as np
import pytest

from attacks.stored.hill_climbing import Prior, answers, climb, learn_prior
from tests.attacks.beds import bed_of
from tests.verify.synthetic import unit


@pytest.fixture(scope="module")
def prior() -> Prior:
    bed = bed_of()
    return learn_prior(bed.gallery[:-50], bed.lift(bed.gallery[-50:], "rehearsal of a test"))


def test_answers_are_the_service_s() -> None:
    bed = bed_of()
    ask = answers(bed, 3)
    (accepted, score), (other, _) = (ask(bed.victims.fresh[row]) for row in (3, 4))
    foot, basis = bed.templates.feet[3], bed.templates.bases[3]
    e = bed.victims.fresh[3].astype(float)
    expected = e @ foot + bed.templates.radii[3] * np.linalg.norm(basis @ e)
    assert score == pytest.approx(expected, abs=1e-4)
    assert (accepted, other) == (True, False)


def test_scores_that_are_noise_lead_nowhere(prior: Prior) -> None:
    """The decisions are the service's; the scores that come with them are drawn."""
    bed = bed_of()
    rng = np.random.default_rng(7)
    reached = []
    for victim in range(12):
        real = answers(bed, victim)
        reached.append(
            climb(
                lambda probe, real=real: (real(probe)[0], float(rng.normal())),
                prior,
                bed.gallery[0],
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
