from dataclasses import replace

import numpy as np
import pytest

from attacks.outcomes import Knowledge, Scheme
from attacks.stored.known_database import (
    attack_with_draws,
    find_decoys,
    known_database_attack,
    likeliest,
    remainder,
)
from attacks.stored.recording import RecordingSource, recorded_lift
from templates.decoys import DecoyPool
from templates.keys.randomness import Keystream
from tests.attacks.stored.systems import (
    VICTIMS,
    M,
    count,
    noise,
    number,
    population,
    share,
    system_of,
)


def test_a_known_pool_gives_every_decoy_and_the_descriptor() -> None:
    exact, *perturbed = known_database_attack(system_of("pool"))
    assert count(exact.details["decoys_found"]) == (VICTIMS * M, VICTIMS * M)
    assert exact.details["false_finds"] == 0
    assert number(exact.details["cosine_to_truth_mean"]) > 0.95
    assert share(exact) > 0.95
    assert exact.judged
    assert exact.knowledge is Knowledge.DECOYS
    assert [outcome.judged for outcome in perturbed] == [False] * 4
    assert all(share(outcome) > 0.9 for outcome in perturbed)


def test_draws_of_a_generator_find_nothing() -> None:
    outcome, told = known_database_attack(system_of("generator"))
    assert (outcome.knowledge, told.knowledge) == (Knowledge.ALGORITHM, Knowledge.DECOYS)
    assert not outcome.judged
    assert not told.judged
    assert share(told) > 0.95
    assert number(told.details["cosine_to_truth_mean"]) > 0.95
    assert count(outcome.details["decoys_found"]) == (0, VICTIMS * M)
    assert outcome.details["false_finds"] == 0
    assert share(outcome) == 0


def test_a_decoy_among_the_draws_is_found() -> None:
    """What no draw can be: some of the templates' own decoys, among other draws."""
    system = system_of("generator")
    lift = recorded_lift(system, system.victims.enrolled, "decoys of a generator")
    with Keystream.seeded("other draws") as stream:
        others = system.lifter.source.draw(1, 500, stream=stream)[0]
    one = attack_with_draws(system, lift, np.concatenate([others, lift.decoys[:, 2]]))
    assert count(one.details["decoys_found"]) == (VICTIMS, VICTIMS * M)
    assert one.details["false_finds"] == 0
    every = np.concatenate([others, lift.decoys.reshape(-1, system.templates.n)])
    all_found = attack_with_draws(system, lift, every)
    assert count(all_found.details["decoys_found"]) == (VICTIMS * M, VICTIMS * M)
    assert share(all_found) > 0.95


def test_a_pool_of_other_people_finds_nothing() -> None:
    system = system_of("pool")
    found = find_decoys(noise(500, system.templates.n), system.templates, most=M)
    assert all(len(entries) == 0 for entries in found.entries)


def test_a_template_of_noise_gives_noise() -> None:
    system = system_of("pool")
    victims = replace(system.victims, fresh=noise(VICTIMS, system.templates.n, seed=1))
    outcome = known_database_attack(replace(system, victims=victims))[0]
    # The decoys are found all the same; what they hide is matched with noise.
    assert count(outcome.details["decoys_found"])[0] == VICTIMS * M
    assert count(outcome.measured.to_json())[0] <= 1


def test_random_lifting_has_no_decoys() -> None:
    system = system_of("generator")
    assert known_database_attack(replace(system, scheme=Scheme("random", None, M))) == []


def test_orthogonal_decoys_leave_exactly_the_descriptor() -> None:
    # d and the decoys are orthonormal: p is their mean, and what is left of it is d / 7.
    rows = np.linalg.qr(np.random.default_rng(0).standard_normal((20, 7)))[0].T
    assert remainder(rows.mean(axis=0), rows[1:]) == pytest.approx(rows[0] / 7)


def test_the_likeliest_point_maximises_the_density_over_the_subspace() -> None:
    # Brute force: the density of the docstring on a grid of the line that is left.
    rng = np.random.default_rng(1)
    n, m = 12, 3
    points = rng.standard_normal((m + 1, n))
    hidden, decoys = points[0], points[1:]
    basis = np.linalg.qr((decoys - hidden).T)[0].T
    foot = hidden - (basis @ hidden) @ basis
    found = likeliest(foot, basis, decoys)
    inside = basis @ (found - foot)
    assert foot + inside @ basis == pytest.approx(found)  # it lies in the subspace
    flat = np.linalg.qr((decoys[1:] - decoys[0]).T)[0]

    def log_density(x: np.ndarray) -> float:
        across = x - decoys[0]
        across = across - flat @ (flat.T @ across)
        return float((n - m) * np.log(np.linalg.norm(across)) - x @ x / 2)

    best = log_density(found)
    for _ in range(300):
        assert log_density(found + 0.3 * rng.standard_normal(m) @ basis) <= best + 1e-9


def test_the_recorded_decoys_lie_in_the_templates() -> None:
    system = system_of("pool")
    lift = recorded_lift(system, system.victims.enrolled[:5], "recorded")
    for row in range(5):
        assert lift.templates[row].contains(lift.decoys[row], tol=2e-3).all()
    again = recorded_lift(system, system.victims.enrolled[:5], "recorded")
    assert np.array_equal(again.templates.bases, lift.templates.bases)


def test_perturbed_decoys_are_as_far_away_as_they_were_moved() -> None:
    pool = DecoyPool(population().attacker)
    source = RecordingSource(pool, noise=0.1)
    with Keystream.seeded("perturbed") as stream:
        drawn = source.draw(4, 3, stream=stream)
    assert np.linalg.norm(drawn, axis=2) == pytest.approx(1)
    moved = np.linalg.norm(drawn - source.last, axis=2)
    assert moved == pytest.approx(0.1, rel=0.15)
