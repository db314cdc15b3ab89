from dataclasses import replace

import numpy as np

from attacks.stored.impersonation import impersonation_attack
from tests.attacks.stored.systems import OWNERS, VICTIMS, M, count, counts, noise, share, system_of


def test_the_owner_of_a_decoy_is_accepted() -> None:
    (outcome,) = impersonation_attack(system_of("pool"))
    assert counts(outcome)[1] == VICTIMS * M
    assert share(outcome) > 0.95
    assert share(outcome) > 100 * outcome.chance
    assert count(outcome.details["with_the_photo_of_the_pool"])[0] == VICTIMS * M
    assert outcome.measured.ci_low <= share(outcome) <= outcome.measured.ci_high


def test_noise_in_place_of_the_owners_is_rejected() -> None:
    system = system_of("pool")
    assert system.owners is not None
    nobody = replace(system.owners, fresh=noise(OWNERS, system.templates.n))
    (outcome,) = impersonation_attack(replace(system, owners=nobody))
    assert counts(outcome)[0] <= 2


def test_people_of_a_generator_are_rejected_like_strangers() -> None:
    (outcome,) = impersonation_attack(system_of("generator"))
    assert share(outcome) < 0.01
    strangers = outcome.details["strangers"]
    assert outcome.chance == count(strangers)[0] / count(strangers)[1]
    assert not outcome.judged  # of 123 people: no service has so few
    assert str(outcome.unjudged).startswith("the attacker's generator was fitted to 123 faces")


def test_people_may_be_given_for_the_fit() -> None:
    """The half that is fitted comes to the templates, and the other half says what chance is."""
    system = system_of("generator")
    enough = 8 * system.templates.n
    (judged,) = impersonation_attack(
        replace(system, attacker=noise(enough, system.templates.n, seed=7))
    )
    assert judged.judged
    assert share(judged) < 0.02
    faces = noise(300, system.templates.n, seed=4)
    (outcome,) = impersonation_attack(replace(system, attacker=faces))
    assert outcome.details["fitted_to"] == 150
    assert counts(outcome)[1] == 150 * VICTIMS
    assert count(outcome.details["strangers"])[1] == 150 * VICTIMS
    assert share(outcome) < 0.02


def test_the_people_of_a_generator_of_very_few_are_accepted() -> None:
    """A fit takes 100 people: here photos of four, of whom its decoys are mixtures then."""
    system = system_of("generator")
    n = system.templates.n
    four = np.tile(noise(4, n, seed=4), (25, 1)) + 0.2 * noise(100, n, seed=5)
    fitted = (four / np.linalg.norm(four, axis=1, keepdims=True)).astype(np.float32)
    (outcome,) = impersonation_attack(
        replace(system, attacker=np.concatenate([fitted, noise(100, n, seed=6)]))
    )
    assert outcome.details["fitted_to"] == 100
    assert counts(outcome)[1] == 100 * VICTIMS
    assert not outcome.judged
    assert share(outcome) > 0.5
    assert outcome.chance < 0.05
