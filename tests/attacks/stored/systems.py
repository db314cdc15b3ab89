"""A small population of synthetic people in R⁶⁴, and systems of it."""

from functools import cache

import numpy as np

from attacks.outcomes import AttackOutcome, Scheme
from attacks.population import Population, draw_population
from attacks.system import System, owners_pool
from templates.contract.canonical import Json
from templates.contract.document import Rate
from templates.decoys import DecoyGenerator
from tests.attacks.conftest import small_system
from tests.verify.synthetic import draw_people
from verify import CalibrationOptions

VICTIMS, OWNERS, M = 40, 120, 6


@cache
def population() -> Population:
    people = draw_people(900, photos=(4, 2, 3), noise=0.35, seed=3)
    return draw_population(people.descriptors, people.names, victims=VICTIMS, owners=OWNERS, seed=0)


@cache
def system_of(decoys: str, strategy: str = "adversarial", m: int = M) -> System:
    source = owners_pool(population(), None) if decoys == "pool" else generator()
    # Fewer comparisons than the audit's, in R⁶⁴, so that a system takes a second or two; as many
    # as FMR 1e-3 is resolved by.
    options = CalibrationOptions(
        probe_dims=(0, 3), lifted_probes=400, lifted_impostor_pairs=40_000, steps=10
    )
    return small_system(
        population(),
        Scheme(strategy, decoys, m),
        source,
        options=options,
        seed=0,
    )


@cache
def generator() -> DecoyGenerator:
    return DecoyGenerator.fit(draw_people(3000, photos=(1,), seed=101).descriptors)


def share(outcome: AttackOutcome) -> float:
    return outcome.measured.value


def interval_holds(outcome: AttackOutcome, value: float) -> bool:
    return outcome.measured.ci_low <= value <= outcome.measured.ci_high


def count(rate: Json) -> tuple[int, int]:
    assert isinstance(rate, dict)
    return int(str(rate["errors"])), int(str(rate["trials"]))


def number(value: Json) -> float:
    assert isinstance(value, float | int)
    return float(value)


def counts(outcome: AttackOutcome) -> tuple[int, int]:
    assert isinstance(outcome.measured, Rate)
    return outcome.measured.errors, outcome.measured.trials


def noise(rows: int, n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((rows, n))
    return (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
