"""A small population of synthetic people in R⁶⁴, and beds of it."""

from functools import cache
from types import SimpleNamespace
from typing import cast

import numpy as np

from attacks.attack import Attack
from attacks.audit import AuditPlan, audit_bed
from attacks.bed import Testbed
from attacks.outcomes import AttackOutcome
from attacks.population import Population, draw_population
from attacks.runner import run_attack
from models.pack import ModelPack
from templates.contract.document import Rate
from templates.decoys import DecoyGenerator, DecoyPool
from templates.space.lifting import Strategy
from tests.verify.synthetic import draw_people, unit
from verify import CalibrationOptions

VICTIMS, OWNERS, M, AXES = 40, 120, 6, 60
PEOPLE = draw_people(900, photos=(4, 2, 3), noise=0.35, seed=3)
PACK = cast(
    "ModelPack",
    SimpleNamespace(info=SimpleNamespace(embedder_sha256="ab" * 32, preprocessing={}, n=64)),
)
# Fewer comparisons than the audit's, so that a bed takes a second or two; as many as FMR 1e-3 is
# resolved by.
PLAN = AuditPlan(
    dims=(M,),
    axes=AXES,
    victims=VICTIMS,
    owners=OWNERS,
    calibration=CalibrationOptions(
        probe_dims=(0, 3), probe_photos=(1,), lifted_probes=400, lifted_impostor_pairs=40_000,
        steps=10,
    ),
)  # fmt: skip


@cache
def population() -> Population:
    return draw_population(PEOPLE.descriptors, PEOPLE.names, victims=VICTIMS, owners=OWNERS, seed=0)


@cache
def generator() -> DecoyGenerator:
    return DecoyGenerator.fit(draw_people(3000, photos=(1,), seed=101).descriptors)


@cache
def bed_of(decoys: str = "generator", strategy: str = "adversarial", m: int = M) -> Testbed:
    """Of ``random``, m = 2, templates hide next to nothing: every attack must succeed."""
    pooled = decoys == "pool"
    return audit_bed(
        population(),
        DecoyPool(population().owners.enrolled) if pooled else generator(),
        Strategy(strategy),
        axes=AXES,
        m=m,
        compared=pooled,
        pack=PACK,
        plan=PLAN,
    )


def weak_bed() -> Testbed:
    return bed_of(strategy="random", m=2)


@cache
def rows_of(attack: Attack, bed: Testbed) -> dict[str, AttackOutcome]:
    """Run an attack; its rows by variant."""
    rows = run_attack(attack, bed)
    by_variant = {row.variant: row for row in rows}
    assert len(by_variant) == len(rows)
    return by_variant


def counts(outcome: AttackOutcome) -> tuple[int, int]:
    assert isinstance(outcome.measured, Rate)
    return outcome.measured.errors, outcome.measured.trials


def is_within_null(row: AttackOutcome) -> bool:
    """Within three standard deviations of the permutation null, as a normal one's 95 % tell them.

    Beyond the 95 % itself lies one row in twenty, be the rotations what they may.
    """
    high = float(str(row.details["null_95_percent"]))
    return row.measured.value <= row.chance + 3 * (high - row.chance) / 1.645


def noise(rows: int, n: int = AXES, seed: int = 0) -> np.ndarray:
    """Unit rows that have nothing to do with anybody."""
    return unit(np.random.default_rng(seed).standard_normal((rows, n)))
