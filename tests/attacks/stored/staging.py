"""A small cast of synthetic people in R⁶⁴, and scenes of it."""

from functools import cache

import numpy as np

from attacks.cast import Cast, make_cast
from attacks.outcomes import Outcome, Scheme
from attacks.scene import Scene, owners_pool, stage
from templates.contract.canonical import Json
from templates.contract.document import Binding, Rate
from templates.decoys import DecoyGenerator
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from tests.verify.synthetic import draw_people
from verify import CalibrationOptions, calibrate

VICTIMS, OWNERS, M = 40, 120, 6


@cache
def cast() -> Cast:
    people = draw_people(900, photos=(4, 2, 3), noise=0.35, seed=3)
    return make_cast(people.descriptors, people.names, victims=VICTIMS, owners=OWNERS, seed=0)


@cache
def scene(decoys: str, strategy: str = "adversarial", m: int = M) -> Scene:
    played = cast()
    source = owners_pool(played, None) if decoys == "pool" else generator()
    binding = Binding(
        embedder_sha256="ab" * 32,
        preprocessing={"size": 112},
        n=source.n,
        strategy=Strategy(strategy),
        m=m,
        decoy_source_id=source.source_id,
        rotation_version=ROTATION_VERSION,
    )
    # Fewer comparisons than the audit's, in R⁶⁴, so that a scene takes a second or two.
    options = CalibrationOptions(
        probe_dims=(0, 3), lifted_probes=200, lifted_impostor_pairs=12_000, steps=10
    )
    contract = calibrate(
        played.calibration, played.names, binding=binding, source=source, options=options
    ).contract
    return stage(
        played,
        Scheme(strategy, decoys, m),
        source,
        embedder_sha256=binding.embedder_sha256,
        preprocessing=binding.preprocessing,
        pool_of_owners=decoys == "pool",
        contract=contract,
        seed=0,
    )


@cache
def generator() -> DecoyGenerator:
    return DecoyGenerator.fit(draw_people(3000, photos=(1,), seed=101).descriptors)


def share(outcome: Outcome) -> float:
    return outcome.measured.value


def interval_holds(outcome: Outcome, value: float) -> bool:
    return outcome.measured.ci_low <= value <= outcome.measured.ci_high


def count(rate: Json) -> tuple[int, int]:
    assert isinstance(rate, dict)
    return int(str(rate["errors"])), int(str(rate["trials"]))


def number(value: Json) -> float:
    assert isinstance(value, float | int)
    return float(value)


def counts(outcome: Outcome) -> tuple[int, int]:
    assert isinstance(outcome.measured, Rate)
    return outcome.measured.errors, outcome.measured.trials


def noise(rows: int, n: int, seed: int = 0) -> np.ndarray:
    points = np.random.default_rng(seed).standard_normal((rows, n))
    return (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
