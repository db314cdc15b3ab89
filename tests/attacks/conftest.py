"""Small synthetic scenes (n = 64) that attacks act on."""

import numpy as np
import pytest

from attacks.cast import Cast, make_cast
from attacks.outcomes import GENERATED, Scheme
from attacks.scene import Scene, stage
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator, DecoyPool
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from tests.verify.synthetic import N, draw_people, make_generator
from verify import CalibrationOptions, calibrate

EMBEDDER = "ab" * 32
PREPROCESSING = {"size": 112}
OPTIONS = CalibrationOptions(
    probe_dims=(0, 2), lifted_probes=150, lifted_impostor_pairs=12_000, steps=20
)


@pytest.fixture(scope="session")
def small_cast() -> Cast:
    people = draw_people(360, photos=(3, 2, 2), noise=0.5, seed=8)
    return make_cast(people.descriptors, people.names, victims=40, owners=2, seed=1)


def staged(cast: Cast, scheme: Scheme, source: DecoyGenerator | None) -> Scene:
    """Stage with a contract of fewer comparisons than the audit's own, for the tests' time."""
    chosen = source or DecoyPool(cast.attacker)
    binding = Binding(
        embedder_sha256=EMBEDDER,
        preprocessing=PREPROCESSING,
        n=N,
        strategy=Strategy(scheme.strategy),
        m=scheme.dim,
        decoy_source_id=chosen.source_id,
        rotation_version=ROTATION_VERSION,
    )
    contract = calibrate(
        cast.calibration, cast.names, binding=binding, source=chosen, options=OPTIONS
    ).contract
    return stage(
        cast,
        scheme,
        source,
        embedder_sha256=EMBEDDER,
        preprocessing=PREPROCESSING,
        pool_of_owners=False,
        contract=contract,
        seed=4,
    )


@pytest.fixture(scope="session")
def scene(small_cast: Cast) -> Scene:
    """Adversarial, m = 6, generated decoys of the people's own kind."""
    return staged(small_cast, Scheme("adversarial", GENERATED, 6), make_generator())


@pytest.fixture(scope="session")
def weak_scene(small_cast: Cast) -> Scene:
    """Random lifting, m = 2: hides next to nothing, so every attack must succeed on it."""
    return staged(small_cast, Scheme("random", None, 2), None)


@pytest.fixture(scope="session")
def strangers() -> np.ndarray:
    """Unit rows that have nothing to do with anybody, (40, 64)."""
    rows = np.random.default_rng(99).normal(size=(40, N))
    return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), dtype=np.float32)
