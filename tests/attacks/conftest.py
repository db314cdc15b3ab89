"""Small synthetic systems (n = 64) that attacks act on."""

import numpy as np
import pytest

from attacks.outcomes import GENERATED, Scheme
from attacks.population import Population, draw_population
from attacks.system import System, enroll_victims
from templates.contract.binding import Binding
from templates.decoys import DecoyPool, DecoySource
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from tests.verify.synthetic import K, draw_people, make_generator
from verify import CalibrationOptions, calibrate

EMBEDDER = "ab" * 32
PREPROCESSING = {"size": 112}
OPTIONS = CalibrationOptions(
    probe_dims=(0, 2), lifted_probes=150, lifted_impostor_pairs=12_000, steps=20
)


@pytest.fixture(scope="session")
def small_population() -> Population:
    people = draw_people(360, photos=(3, 2, 2), noise=0.5, seed=8)
    return draw_population(people.descriptors, people.names, victims=40, owners=2, seed=1)


def small_system(
    population: Population,
    scheme: Scheme,
    source: DecoySource | None,
    *,
    options: CalibrationOptions = OPTIONS,
    seed: int = 4,
) -> System:
    """Enroll with a contract of fewer comparisons than the audit's own, for the tests' time."""
    chosen = source or DecoyPool(population.attacker)
    binding = Binding(
        embedder_sha256=EMBEDDER,
        preprocessing=PREPROCESSING,
        n=chosen.n,
        axes=chosen.k,
        strategy=Strategy(scheme.strategy),
        m=scheme.dim,
        decoy_source_id=chosen.source_id,
        rotation_version=ROTATION_VERSION,
    )
    contract = calibrate(
        population.calibration, population.names, binding=binding, source=chosen, options=options
    ).contract
    return enroll_victims(
        population,
        scheme,
        source,
        embedder_sha256=EMBEDDER,
        preprocessing=PREPROCESSING,
        contract=contract,
        seed=seed,
    )


@pytest.fixture(scope="session")
def system(small_population: Population) -> System:
    """Adversarial, m = 6, generated decoys of the people's own kind."""
    return small_system(small_population, Scheme("adversarial", GENERATED, 6), make_generator())


@pytest.fixture(scope="session")
def weak_system(small_population: Population) -> System:
    """Random lifting, m = 2: hides next to nothing, so every attack must succeed on it."""
    return small_system(small_population, Scheme("random", None, 2), None)


@pytest.fixture(scope="session")
def strangers() -> np.ndarray:
    """Unit rows on the axes that have nothing to do with anybody, (40, 60)."""
    rows = np.random.default_rng(99).normal(size=(40, K))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)
