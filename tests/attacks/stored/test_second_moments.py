from dataclasses import replace

import numpy as np
import pytest

from attacks.outcomes import AttackOutcome, Scheme
from attacks.privacy import Pairs
from attacks.stored.second_moments import Guesser, audit_setup, second_moments_attack
from attacks.system import System
from attacks.verdict import Status, judge
from templates.decoys import DecoyGenerator
from tests.attacks.stored.systems import generator, population, system_of
from tests.verify.synthetic import unit


def attacked(system: System) -> list[AttackOutcome]:
    people = population()
    victims = Pairs(people.victims.enrolled, people.victims.fresh)
    source = generator().reduced(system.source.k)
    setup = audit_setup(victims, people.known, people.known_names, source, seed=0)
    return second_moments_attack(system, setup, kind="a test")


def test_every_attacker_of_a_verdict_is_reported_and_the_few_show_nothing() -> None:
    *rows, control = attacked(system_of("generator"))
    variants = [row.variant for row in rows]
    assert len(variants) == len(set(variants))
    assert [name for name in ("photos", "one photo", "the mean", "exact") if name in str(variants)]
    assert variants[-1] == "unlimited faces, exact moments"
    assert all(row.judged for row in rows)
    assert not control.judged
    assert control.measured.value <= max(row.measured.value for row in rows)
    (verdict,) = judge([row for row in rows if row.measured.value <= 0.05] or rows[:1])
    assert verdict.cells[0].status in (Status.NOT_SHOWN, Status.FAIL)
    assert "it takes 100 victims" in str(rows[0].details["too_few"])


@pytest.mark.parametrize(("strategy", "m"), [("adversarial", 6), ("hybrid", 8), ("random", 4)])
def test_decoys_unlike_the_faces_give_the_embedding_away(strategy: str, m: int) -> None:
    known = system_of("generator")
    rows = np.random.default_rng(0).normal(size=(2_000, known.source.k))
    wide = np.where(np.arange(known.source.k) < 10, 3.0, 1.0)
    source = DecoyGenerator.fit(unit(rows * wide)).in_coordinates_of_embeddings()
    decoys = None if strategy == "random" else "generator"
    narrow = np.where(np.arange(known.source.k) < 10, 0.1, 1.0)
    people = unit(np.random.default_rng(1).normal(size=(800, known.source.k)) * narrow)
    system = replace(
        known,
        scheme=Scheme(strategy, decoys, m),
        source=source,
        attacker=people[40:],
        victims=replace(known.victims, enrolled=people[:40]),
    )
    templates = system.lift(people[:40], "decoys of another kind")
    near = np.einsum("ij,ij->i", Guesser(system)(templates), people[:40])
    assert near.mean() > templates.foot_norms.mean() + (0.1 if decoys else -0.05)
