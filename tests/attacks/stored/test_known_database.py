from dataclasses import replace

from attacks.outcomes import Knowledge, Scheme
from attacks.stored.known_database import known_database_attack
from tests.attacks.stored.systems import VICTIMS, M, counts, noise, number, share, system_of


def test_a_known_pool_gives_every_decoy_and_the_embedding() -> None:
    (outcome,) = known_database_attack(system_of("pool"))
    assert number(outcome.details["decoys_found_mean"]) == M
    assert number(outcome.details["cosine_to_truth_mean"]) > 0.95
    assert share(outcome) > 0.95
    assert outcome.judged
    assert outcome.knowledge is Knowledge.DECOYS


def test_a_template_of_noise_gives_noise() -> None:
    system = system_of("pool")
    victims = replace(system.victims, fresh=noise(VICTIMS, system.templates.n, seed=1))
    (outcome,) = known_database_attack(replace(system, victims=victims))
    # The decoys are found all the same; what they hide is matched with noise.
    assert number(outcome.details["decoys_found_mean"]) == M
    assert counts(outcome)[0] <= 1


def test_there_is_no_pool_to_know_of_a_generator_and_of_random_lifting() -> None:
    system = system_of("generator")
    assert known_database_attack(system) == []
    assert known_database_attack(replace(system, scheme=Scheme("random", None, M))) == []
