"""A small real deployment: a tiny ONNX pack, a contract, decoys, a database, API keys."""

import functools
import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from api.service.opening import (
    file_sealer,
    open_keyring,
    open_store,
    prepare_database,
)
from api.settings import DEFAULT_TENANT, ENV_PREFIX, Settings
from models.pack import ModelPack
from templates.contract.document import Binding, Calibration, Contract, Level, Rate
from templates.contract.verdict import Judgement, Verdict
from templates.decoys import DecoyGenerator, DecoySource
from templates.distances import Metric
from templates.keys.rotation import ROTATION_VERSION
from templates.space.lifting import Strategy
from templates.store.api_keys import Right
from tests.databases import migrate_ahead
from verify.calibration_mode import STEPS

N = 64
AXES = 60
"""That embeddings are projected on: all but four."""
M = 8
PROBE_M = 2
RATE = Rate(errors=1, trials=1000, ci_low=0.0, ci_high=0.01)
VERDICT = Verdict(
    privacy=Judgement(
        RATE, 0.05, {"axes": AXES, "m": M, "attack": "made up", "attacker_faces": 1000}
    ),
    accuracy=Judgement(RATE, 0.02, {"level": "fmr-1e-3", "enrolled_photos": 3, "probe_photos": 1}),
)


def write_pack(folder: Path) -> Path:
    """A pack without a detector: a fixed random projection of the pooled crop."""
    rng = np.random.default_rng(1)
    matrix = rng.normal(size=(14 * 14 * 3, N)).astype(np.float32)
    graph = helper.make_graph(
        [
            helper.make_node(
                "AveragePool", ["data"], ["pooled"], kernel_shape=[8, 8], strides=[8, 8]
            ),
            helper.make_node("Flatten", ["pooled"], ["flat"], axis=1),
            helper.make_node("MatMul", ["flat", "matrix"], ["embedding"]),
        ],
        "tiny",
        [helper.make_tensor_value_info("data", TensorProto.FLOAT, ["batch", 3, 112, 112])],
        [helper.make_tensor_value_info("embedding", TensorProto.FLOAT, ["batch", N])],
        [numpy_helper.from_array(matrix, "matrix")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    folder.mkdir(parents=True, exist_ok=True)
    onnx.save(model, folder / "tiny.onnx")
    return folder


def picture(person: int, shot: int = 0) -> NDArray[np.uint8]:
    """A 112 x 112 pattern of one "person", with a little noise of the shot."""
    base = np.random.default_rng([7, person]).integers(0, 256, (14, 14, 3))
    noise = np.random.default_rng([8, person, shot]).normal(0, 8, (14, 14, 3))
    small = np.clip(base + noise, 0, 255).astype(np.uint8)
    return np.repeat(np.repeat(small, 8, axis=0), 8, axis=1)


def photo(person: int, shot: int = 0, *, form: str = "PNG", **options: Any) -> bytes:
    """:func:`picture` as a file."""
    out = io.BytesIO()
    Image.fromarray(picture(person, shot)).save(out, form, **options)
    return out.getvalue()


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rows of norm 1."""
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


@functools.cache
def make_source(n: int = N) -> DecoyGenerator:
    """Decoys of all axes but four, so that embeddings are projected."""
    rng = np.random.default_rng(3)
    return DecoyGenerator.fit(unit(rng.normal(size=(400, n)))).reduced(n - N + AXES)


def make_contract(
    pack: ModelPack, source: DecoySource, *, threshold: float = 5.5, **changes: Any
) -> Contract:
    """A contract whose thresholds suit the patterns of :func:`picture`.

    The people of the tests score above 6.9 with their own templates and below 3.7 with others'; at
    3.0 one stranger in a thousand would be accepted, and a test would fail by chance.
    """
    binding = Binding(
        **{
            "embedder_sha256": pack.info.embedder_sha256,
            "preprocessing": pack.info.preprocessing,
            "n": pack.info.n,
            "axes": source.k,
            "strategy": Strategy.ADVERSARIAL,
            "m": M,
            "decoy_source_id": source.source_id,
            "rotation_version": ROTATION_VERSION,
            **changes,
        }
    )
    levels = (
        Level("fmr-1e-2", 1e-2, 2.5, RATE, RATE),
        Level("fmr-1e-3", 1e-3, threshold, RATE, RATE),
        Level("accuracy", None, 2.0, RATE, RATE),
    )
    calibrations = (
        Calibration("p2s", Metric.SPHERICAL, 0, STEPS, levels, None),
        Calibration("s2s", Metric.SPHERICAL, PROBE_M, STEPS, levels, (0.3, 0.95)),
    )
    return Contract(
        binding=binding,
        recorded={"pack": pack.info.name},
        calibrations=calibrations,
        default_level="fmr-1e-3",
        photo_consistency=0.5,
        probe_consistency=0.5,
        template_foot_point_norm=(0.1, 0.8),
        # Honest lifts stay below 0.361 (800 templates), and their mean is 0.349.
        template_stranger_similarity=0.39,
        cohort_seed=bytes(range(32)),
        verdict=VERDICT,
    )


@dataclass(frozen=True)
class Deployment:
    """Files of a deployment, its settings and the token of its first key."""

    settings: Settings
    token: str
    contract: Contract
    source: DecoySource

    def key(self, *rights: str, tenant: str = "default", **options: Any) -> str:
        """Make another API key; return its token."""
        store = open_store(self.settings, open_keyring(self.settings))
        try:
            store.tenants.create(tenant)
            return store.api_keys.create(tenant, rights, **options).token
        finally:
            store.close()

    def allow_templates(self, tenant: str = "default", *, allowed: bool = True) -> None:
        """Do what `veilface db template-enrollment --allow` does."""
        store = open_store(self.settings, open_keyring(self.settings))
        try:
            store.tenants.set_template_enrollment(tenant, allowed)
        finally:
            store.close()


def deploy(folder: Path, *, database_url: str | None = None, **changes: Any) -> Deployment:
    """Write a deployment into ``folder``."""
    pack_dir = changes.pop("pack", None) or write_pack(folder / "tiny")
    pack = ModelPack.load(pack_dir, threads=1)
    source = make_source(pack.info.n)
    contract = make_contract(pack, source, threshold=changes.pop("threshold", 6.5))
    settings = Settings(
        **{
            "data_dir": folder / "data",
            "database_url": database_url,
            "pack": pack_dir,
            "compute_slots": 2,
            **changes,
        }
    )
    keyring = open_keyring(settings)
    contract.save(settings.resolved_contract_file, file_sealer(keyring))
    source.save(settings.resolved_decoys_file)
    if database_url is None:
        migrate_ahead(settings.resolved_database_url)
    store = open_store(settings, keyring)
    try:
        prepare_database(store)
        store.tenants.create(DEFAULT_TENANT)
        first = store.api_keys.create(DEFAULT_TENANT, tuple(Right))
    finally:
        store.close()
    return Deployment(settings, first.token, contract, source)


def environment_of(settings: Settings) -> dict[str, str]:
    """All settings as environment variables, for a process that takes them from there."""
    values = {name: getattr(settings, name) for name in Settings.model_fields}
    return {
        ENV_PREFIX + name.upper(): ",".join(value) if isinstance(value, tuple) else str(value)
        for name, value in values.items()
        if value is not None
    }


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def images(*files: bytes, name: str = "images") -> list[tuple[str, tuple[str, bytes, str]]]:
    """Files for httpx's ``files=``."""
    return [(name, (f"{i}.png", data, "image/png")) for i, data in enumerate(files)]


def codes(answers: Iterable[Any]) -> list[int]:
    return [answer.status_code for answer in answers]
