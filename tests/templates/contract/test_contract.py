"""The contract: ids, its file, and everything that must not pass as a file."""

import base64
import dataclasses
import functools
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from templates.contract import document as contract_module
from templates.contract.canonical import MAX_PARTS, canonical_json
from templates.contract.document import (
    Binding,
    Calibration,
    Contract,
    Level,
    LivenessCalibration,
    Rate,
)
from templates.contract.levels import GroupRates
from templates.contract.verdict import Judgement, Verdict
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.errors import ContractError, ContractMismatch, SealError, Uncalibrated
from templates.keys.rotation import ROTATION_VERSION
from templates.keys.sealing import MasterKeyring, Sealer
from templates.space.lifting import Strategy

N, M = 16, 3
SEALER = Sealer(MasterKeyring([os.urandom(32)]))
RATE = Rate(errors=2, trials=1000, ci_low=0.0005, ci_high=0.007)
GRAPHS = ("0a" * 32, "1b" * 32)
GROUP = GroupRates("gender", "Female", RATE, RATE, True, False)
VERDICT = Verdict(
    privacy=Judgement(RATE, 0.05, {"attack": "second moments"}, bound=0.1),
    accuracy=Judgement(RATE, 0.02, {"level": "fmr-1e-4"}, shortfall="few"),
    groups=Judgement(RATE, 0.02),
)
LIVENESS = LivenessCalibration(
    graphs=GRAPHS,
    threshold=0.75,
    bpcer=RATE,
    target_bpcer=0.05,
    apcer={"print": RATE, "screen": Rate(9, 100, 0.05, 0.16)},
    calibrated_on={"dataset": "booth", "subjects": None},
)


def make_binding(**changes: Any) -> Binding:
    fields: dict[str, Any] = {
        "embedder_sha256": "ab" * 32,
        "preprocessing": {"size": 112, "mean": (127.5, 127.5, 127.5), "flip": False},
        "n": N,
        "axes": N - 2,
        "strategy": Strategy.RANDOM,
        "m": M,
        "decoy_source_id": "cd" * 32,
        "rotation_version": ROTATION_VERSION,
    }
    return Binding(**{**fields, **changes})


@functools.cache
def make_source() -> DecoyGenerator:
    rows = np.random.default_rng(4).normal(size=(200, N)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return DecoyGenerator.fit(rows).reduced(N - 2)


def make_calibration(**changes: Any) -> Calibration:
    fields: dict[str, Any] = {
        "mode": "p2s",
        "metric": Metric.SPHERICAL,
        "probe_m": 0,
        "steps": 50,
        "levels": (
            Level("fmr-1e-2", 1e-2, 2.0, RATE, RATE, {1: RATE, 3: RATE}, {3: RATE}, (GROUP,)),
            Level("accuracy", None, 3.0, RATE, RATE),
        ),
        "foot_point_norm": None,
        "calibrated_on": {"people": 80, "share": 1.0},
    }
    return Calibration(**{**fields, **changes})


LIFTED = {"mode": "s2s", "probe_m": 2, "foot_point_norm": (0.2, 0.9)}


def make_contract(**changes: Any) -> Contract:
    fields: dict[str, Any] = {
        "binding": make_binding(),
        "recorded": {"pack": "tiny", "detector": {"kind": "scrfd", "input": (640, 640)}},
        "calibrations": (make_calibration(), make_calibration(**LIFTED)),
        "default_level": "fmr-1e-2",
        "photo_consistency": 0.25,
        "probe_consistency": 0.2,
        "template_foot_point_norm": (0.1, 0.8),
        "template_stranger_similarity": 0.7,
        "cohort_seed": bytes(range(32)),
        "verdict": VERDICT,
        "liveness": LIVENESS,
    }
    return Contract(**{**fields, **changes})


# --- ids -----------------------------------------------------------------------------------


def test_contract_id_is_the_hash_of_the_canonical_json() -> None:
    written = (
        '{"axes":14,"decoy_source_id":"'
        + "cd" * 32
        + '","embedder_sha256":"'
        + "ab" * 32
        + '","m":3,"n":16,'
        '"preprocessing":{"flip":false,"mean":[127.5,127.5,127.5],"size":112},'
        '"rotation_version":"signs-hartley-1","strategy":"random"}'
    )
    assert make_binding().contract_id == hashlib.sha256(written.encode("utf-8")).hexdigest()
    # However the values are written.
    preprocessing = {"mean": [127.5] * 3, "flip": False, "size": 112.0}
    assert make_binding(preprocessing=preprocessing) == make_binding()
    # The space of the embeddings is that of the weights and the preprocessing alone.
    space = make_binding().embedding_id
    assert make_binding(m=2).embedding_id == space
    assert make_binding(preprocessing={"flip": 1}).embedding_id != space
    assert make_binding(embedder_sha256="ef" * 32).embedding_id != space


def test_recalibrating_keeps_the_contract_id_and_changes_the_calibration_id() -> None:
    first = make_contract()
    levels = (Level("fmr-1e-2", 1e-2, 2.1, RATE, RATE),)
    again = make_contract(calibrations=(make_calibration(levels=levels),), liveness=None)
    assert first.calibrations[0].calibration_id != again.calibrations[0].calibration_id
    assert first.contract_id == again.contract_id
    assert make_contract(verdict=None).calibrations == first.calibrations


def test_canonical_json_agrees_with_sorted_compact_json() -> None:
    value = {"é": [1, 2.5, True, None], "a": {"z": "\n", "b": -0.125}}
    expected = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert canonical_json(value) == expected.encode("utf-8")
    deep: Any = 0
    for _ in range(100_000):
        deep = [deep]
    for broken in (float("nan"), float("inf"), "\ud800", object(), b"x", {1: 2}, deep):
        with pytest.raises(ContractError):
            canonical_json({"x": broken})


# --- values --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"photo_consistency": 1.5},
        {"template_foot_point_norm": (0.1, 1.5)},
        {"template_stranger_similarity": float("nan")},
        {"cohort_seed": b"short"},
        {"calibrations": (make_calibration(steps=0),)},
        {"calibrations": (make_calibration(foot_point_norm=(-0.1, 0.2)),)},
        {"calibrations": (make_calibration(probe_photos=6),)},
        {"calibrations": (make_calibration(levels=(Level("fmr-1e-2", 2.0, 0, RATE, RATE),)),)},
        {"liveness": dataclasses.replace(LIVENESS, graphs=("0A" * 32,))},
        {"liveness": dataclasses.replace(LIVENESS, apcer={"a/b": RATE})},
        {"verdict": Verdict(Judgement(RATE, 1.0))},
    ],
)
def test_what_could_not_be_read_is_not_written(tmp_path: Path, changes: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        make_contract(**changes).save(tmp_path / "contract.json", SEALER)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("make", "changes", "reason"),
    [
        (make_contract, {"default_level": "fmr-1e-9"}, "default level"),
        (make_contract, {"calibrations": ()}, "default level"),
        (
            make_contract,
            {"calibrations": (make_calibration(), make_calibration(steps=9))},
            "share mode",
        ),
        (
            make_contract,
            {"calibrations": (make_calibration(), make_calibration(metric=Metric.EUCLIDEAN))},
            "one metric",
        ),
        (make_calibration, {"levels": make_calibration().levels[:1] * 2}, "bear one name"),
        (make_binding, {"m": N - 2}, "m < axes"),
        (make_binding, {"axes": N + 1}, "m < axes"),
        (make_binding, {"rotation_version": ""}, "turns templates by"),
        (functools.partial(Rate, 3, 2, 0.5, 1.0), {}, "more errors than trials"),
    ],
)
def test_contradictions_are_refused(
    make: Callable[..., object], changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ContractError, match=reason):
        make(**changes)


def test_calibrations_are_found_or_the_choice_is_named() -> None:
    contract = make_contract()
    assert contract.calibration("p2s").probe_m == 0
    assert contract.calibration("s2s", Metric.SPHERICAL, 2).mode == "s2s"
    with pytest.raises(Uncalibrated, match="s2s spherical m=2"):
        contract.calibration("s2s", None, 4)
    with pytest.raises(Uncalibrated):
        contract.calibration("p2s", Metric.EUCLIDEAN)
    assert contract.calibration("p2s").level("accuracy").target_fmr is None
    with pytest.raises(Uncalibrated, match="fmr-1e-2, accuracy"):
        contract.calibration("p2s").level("fmr-1e-3")


def test_the_calibration_of_the_most_photos_that_are_not_more_serves() -> None:
    lax, strict = make_calibration().levels[0], Level("fmr-1e-4", 1e-4, 4.0, RATE, RATE)
    contract = make_contract(
        calibrations=(
            make_calibration(levels=(lax, strict)),
            make_calibration(levels=(lax, strict), probe_photos=2),
            make_calibration(levels=(lax,), probe_photos=5),
            make_calibration(**LIFTED),
        )
    )
    chosen = [
        contract.calibration("p2s", probe_photos=photos).probe_photos for photos in range(1, 9)
    ]
    assert chosen == [1, 2, 2, 2, 5, 5, 5, 5]
    # A level that more photos do not resolve is taken from fewer.
    assert contract.calibration("p2s", probe_photos=5, level="fmr-1e-4").probe_photos == 2
    assert contract.calibration("p2s", probe_photos=5, level="none").probe_photos == 5
    assert contract.calibration("s2s", None, 2, 3).probe_photos == 1
    with pytest.raises(Uncalibrated):
        contract.calibration("p2s", probe_photos=0)


def test_mismatches_name_both_sides() -> None:
    source = make_source()
    parts = source.axes, source.mean, source.root
    binding = make_binding()
    bound = make_binding(decoy_source_id=source.source_id)
    bound.require_source(source)
    same = {"embedder_sha256": "ab" * 32, "preprocessing": dict(binding.preprocessing), "n": N}
    binding.require_embedder(**same)
    binding.require_contract(binding.contract_id, what="it")
    with pytest.raises(ContractMismatch, match=r"abab.*pack's is efef"):
        binding.require_embedder(**{**same, "embedder_sha256": "ef" * 32})
    preprocessing = {**binding.preprocessing, "size": 96, "x": 1}
    with pytest.raises(ContractMismatch, match=r"size: contract 112, pack 96; x: contract None"):
        binding.require_embedder(**{**same, "preprocessing": preprocessing})
    with pytest.raises(ContractMismatch, match=rf"cdcd.*{source.source_id[:16]}"):
        binding.require_source(source)
    with pytest.raises(ContractMismatch, match="build the decoys with this pack and the same --fl"):
        binding.require_source(DecoyGenerator(*parts, made_with="00" * 32))
    with pytest.raises(ContractMismatch, match=r"it belongs to the contract 1111.*runs"):
        binding.require_contract("1" * 64, what="it")


def test_nobody_is_made_once_of_the_contracts_decoys() -> None:
    source = make_source()
    contract = make_contract(binding=make_binding(decoy_source_id=source.source_id))
    assert contract.nobody(source) is contract.nobody(source)
    assert "seed" not in repr(contract.nobody(source))
    with pytest.raises(ContractMismatch, match="bound to the decoy source"):
        make_contract().nobody(source)


def test_at_the_threshold_is_live() -> None:
    assert LIVENESS.is_live(0.75)
    assert not LIVENESS.is_live(0.7499)
    assert not LIVENESS.is_live(float("nan"))
    assert LIVENESS.worst_species == "screen"
    LIVENESS.require_graphs(GRAPHS)
    for other in (GRAPHS[:1], GRAPHS[::-1], ()):
        with pytest.raises(Uncalibrated, match="calibrate --liveness"):
            LIVENESS.require_graphs(other)


# --- the file ------------------------------------------------------------------------------


def saved(tmp_path: Path, contract: Contract | None = None) -> Path:
    path = tmp_path / "contract.json"
    (contract or make_contract()).save(path, SEALER)
    return path


def reloaded(path: Path, document: Any) -> Contract:
    path.write_text(json.dumps(document))
    return Contract.load(path, SEALER)


@pytest.mark.parametrize(
    "changes",
    [{}, {"verdict": None, "liveness": None}, {"verdict": Verdict(VERDICT.privacy)}],
)
def test_a_file_keeps_everything(tmp_path: Path, changes: dict[str, Any]) -> None:
    contract = make_contract(**changes)
    path = saved(tmp_path, contract)
    document = json.loads(path.read_text())
    path.write_text(json.dumps(dict(reversed(document.items())), indent=7))
    loaded = Contract.load(path, SEALER)
    assert loaded.to_json() == contract.to_json()
    assert loaded.binding == contract.binding
    assert loaded.calibrations == contract.calibrations
    assert (loaded.verdict, loaded.liveness) == (contract.verdict, contract.liveness)
    assert loaded.cohort_seed == contract.cohort_seed


def test_the_seed_of_the_cohort_is_sealed_and_never_public(tmp_path: Path) -> None:
    contract = make_contract()
    text = saved(tmp_path, contract).read_bytes()
    raw = text + base64.b64decode(json.loads(text)["sealed"])
    seed = contract.cohort_seed
    for form in (seed, seed.hex().encode(), base64.b64encode(seed)):
        assert form not in raw
        # Positive control: the same search finds a seed that was planted.
        assert form in raw + form
    public = json.dumps(contract.to_json())
    assert "sealed" not in contract.to_json()
    assert seed.hex() not in public
    assert "seed" not in repr(contract)


def test_another_master_key_does_not_open_it(tmp_path: Path) -> None:
    other = Sealer(MasterKeyring([os.urandom(32)]))
    with pytest.raises(SealError, match=r"master key is not the one .* or the file was edited"):
        Contract.load(saved(tmp_path), other)


@pytest.mark.parametrize(
    ("key", "value"),
    [("format", "other"), ("version", 2), ("version", True), ("sealed", "!!!"), ("sealed", 3)],
)
def test_another_kind_of_file_is_refused(tmp_path: Path, key: str, value: Any) -> None:
    document = json.loads(saved(tmp_path).read_text())
    with pytest.raises(ContractError):
        reloaded(tmp_path / "contract.json", document | {key: value})


def wrong_threshold() -> dict[str, Any]:
    calibration: dict[str, Any] = make_calibration().to_json()
    calibration["levels"][0]["score_threshold"] = "high"
    return calibration


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"photo_consistency": "0.25"}, "photo_consistency: "),
        ({"photo_consistency": None}, "photo_consistency: "),
        ({"template_foot_point_norm": [0.1, True]}, r"template_foot_point_norm\.1: input"),
        ({"binding": {}}, "binding"),
        ({"default_level": "no such\n"}, "default_level: "),
        ({"contract_id": "0" * 64}, "contradicts"),
        ({"calibrations": [wrong_threshold()]}, r"calibrations\.0\.levels\.0\.score_threshold: "),
        ({"surprise": 1}, "too many"),
        ({"verdict": {"privacy": VERDICT.privacy.to_json() | {"status": "FAIL"}}}, "contradicts"),
        ({"liveness": LIVENESS.to_json() | {"bpcer": {}}}, "liveness"),
    ],
)
def test_a_value_of_another_type_or_range_is_refused(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(ContractError, match=reason):
        Contract.from_json(make_contract().to_json() | changes, cohort_seed="00" * 32)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


@settings(
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(st.data())
def test_no_edit_of_a_value_is_accepted(tmp_path: Path, data: st.DataObject) -> None:
    """The seal covers all: verdict, liveness, groups and thresholds."""
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    place: Any = document
    while True:
        keys = sorted(place) if isinstance(place, dict) else list(range(len(place)))
        key = data.draw(st.sampled_from(keys))
        if isinstance(place[key], dict | list) and place[key] and data.draw(st.booleans()):
            place = place[key]
            continue
        break
    value = data.draw(json_values | st.just("removed"))
    if value == place[key]:
        return
    place[key] = value
    if value == "removed":
        del place[key]
    with pytest.raises((ContractError, SealError)):
        reloaded(path, document)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"\xff\xfe",
        b'{"format": NaN}',
        b'{"format": "a", "format": "b"}',
        b'{"a":' * 90_000,
        b'{"version": ' + b"9" * 5000 + b"}",
        b"[" * (MAX_PARTS + 1),
    ],
    ids=range(8),
)
def test_what_is_no_json_object_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "contract.json"
    path.write_bytes(data)
    with pytest.raises(ContractError):
        Contract.load(path, SEALER)


def test_an_absent_or_long_file_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path)
    monkeypatch.setattr(contract_module, "MAX_FILE_BYTES", path.stat().st_size - 1)
    for file, cause in ((path, "more than"), (tmp_path / "none.json", "No such file")):
        with pytest.raises(ContractError, match=f"{cause}.*veilface calibrate"):
            Contract.load(file, SEALER)
