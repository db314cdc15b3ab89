"""The contract: ids, the file, and everything that must not pass as a file."""

import base64
import dataclasses
import errno
import functools
import hashlib
import json
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from templates.contract import document as contract_module
from templates.contract.canonical import MAX_ITEMS, MAX_PARTS, canonical_json, too_many_parts
from templates.contract.document import (
    MAX_CALIBRATIONS,
    Binding,
    Calibration,
    Contract,
    Level,
    Rate,
)
from templates.contract.levels import MAX_LEVELS
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.errors import ContractError, ContractMismatch, SealError, Uncalibrated
from templates.keys.rotation import ROTATION_VERSION
from templates.keys.sealing import KeyringSealer, MasterKeyring
from templates.space.lifting import Strategy

N, M = 16, 3
SEALER = KeyringSealer(MasterKeyring([os.urandom(32)]))
RATE = Rate(errors=2, trials=1000, ci_low=0.0005, ci_high=0.007)


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
            Level("fmr-1e-2", 1e-2, 2.0, RATE, RATE, {1: RATE, 3: RATE}),
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
        '"rotation_version":"signs-cosine-2","strategy":"random"}'
    )
    assert make_binding().contract_id == hashlib.sha256(written.encode("utf-8")).hexdigest()


def test_contract_id_depends_on_values_not_on_how_they_are_written() -> None:
    preprocessing = {"mean": [127.5] * 3, "flip": False, "size": 112.0}
    assert make_binding(preprocessing=preprocessing) == make_binding()
    assert make_binding(preprocessing=preprocessing).contract_id == make_binding().contract_id


@pytest.mark.parametrize(
    "changes",
    [
        {"embedder_sha256": "ac" * 32},
        {"preprocessing": {"size": 112, "mean": (127.5, 127.5, 127.5), "flip": True}},
        {"n": 17},
        {"axes": 15},
        {"strategy": Strategy.HYBRID},
        {"m": 4},
        {"decoy_source_id": "ce" * 32},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_part_of_the_binding_changes_the_id(changes: dict[str, Any]) -> None:
    assert make_binding(**changes).contract_id != make_binding().contract_id


def test_recalibrating_keeps_the_contract_id_and_changes_the_calibration_id() -> None:
    first = make_contract()
    levels = (Level("fmr-1e-2", 1e-2, 2.1, RATE, RATE),)
    again = make_contract(calibrations=(make_calibration(levels=levels),))
    ids = {entry.calibrations[0].calibration_id for entry in (first, again)}
    assert len(ids) == 2
    assert len({entry.contract_id for entry in (first, again)}) == 1
    assert make_contract().calibrations[0].calibration_id in ids


def test_canonical_json_agrees_with_sorted_compact_json() -> None:
    value = {"é": [1, 2.5, True, None], "a": {"z": "\n", "b": -0.125}}
    expected = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert canonical_json(value) == expected.encode("utf-8")
    for broken in (float("nan"), float("inf"), "\ud800", object(), 2**60, b"x", {1: 2}):
        with pytest.raises(ContractError):
            canonical_json({"x": broken})
    deep: Any = 0
    for _ in range(50):
        deep = [deep]
    with pytest.raises(ContractError, match="too deep"):
        canonical_json(deep)


# --- values --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {"embedder_sha256": "AB" * 32},
        {"decoy_source_id": "cd"},
        {"n": 1},
        {"n": 5000},
        {"m": 0},
        {"m": N},
        {"rotation_version": ""},
        {"preprocessing": {"mean": float("nan")}},
    ],
)
def test_impossible_bindings_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        make_binding(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"mode": "s2s"},
        {"probe_m": 2},
        {"foot_point_norm": (0.1, 0.2)},
        {**LIFTED, "foot_point_norm": (0.9, 0.2)},
        {"steps": 0},
        {"levels": ()},
        {"levels": (Level("a", 1e-2, 0, RATE, RATE),) * 2},
        {"mode": "raw"},
        {"probe_photos": 0},
        {"probe_photos": 6},
        {**LIFTED, "probe_photos": 2},
    ],
)
def test_impossible_calibrations_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        make_calibration(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"photo_consistency": 1.5},
        {"probe_consistency": -1.5},
        {"template_foot_point_norm": (0.8, 0.1)},
        {"template_stranger_similarity": float("nan")},
        {"cohort_seed": b"short"},
        {"default_level": "fmr-1e-9"},
        {"calibrations": ()},
        {"calibrations": (make_calibration(), make_calibration(steps=9))},
        {"calibrations": (make_calibration(calibration_id="0" * 64),)},
        {"calibrations": (make_calibration(), make_calibration(metric=Metric.EUCLIDEAN))},
        {"calibrations": (make_calibration(**LIFTED | {"probe_m": N - 2}),)},
    ],
)
def test_contradictions_are_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ContractError):
        make_contract(**changes)


@pytest.mark.parametrize("counts", [(3, 2, 0.0, 1.0), (-1, 2, 0.0, 1.0), (1, 2, 0.7, 0.2)])
def test_impossible_rates_are_refused(counts: tuple[int, int, float, float]) -> None:
    with pytest.raises(ContractError):
        Rate(*counts)


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


def test_mismatches_name_both_sides() -> None:
    binding = make_binding()
    same = {"embedder_sha256": "ab" * 32, "preprocessing": dict(binding.preprocessing), "n": N}
    binding.require_embedder(**same)
    binding.require_source(source_id="cd" * 32)
    binding.require_contract(binding.contract_id, what="it")
    with pytest.raises(ContractMismatch, match=r"abab.*pack's is efef"):
        binding.require_embedder(**{**same, "embedder_sha256": "ef" * 32})
    preprocessing = {**binding.preprocessing, "size": 96, "x": 1}
    with pytest.raises(ContractMismatch, match=r"size: contract 112, pack 96; x: contract None"):
        binding.require_embedder(**{**same, "preprocessing": preprocessing})
    later = {**binding.preprocessing, "version": 2}
    with pytest.raises(ContractMismatch, match=r"version: contract None, pack 2; .*enroll anew"):
        binding.require_embedder(**{**same, "preprocessing": later})
    with pytest.raises(ContractMismatch, match=r"cdcd.*0000"):
        binding.require_source(source_id="00" * 32)
    binding.require_source(source_id="cd" * 32, made_with=binding.embedding_id)
    with pytest.raises(ContractMismatch, match="build the decoys with this pack and the same --fl"):
        binding.require_source(source_id="cd" * 32, made_with="00" * 32)
    with pytest.raises(ContractMismatch, match=r"it belongs to the contract 1111.*runs"):
        binding.require_contract("1" * 64, what="it")


def test_the_embedding_id_names_the_weights_and_the_preprocessing() -> None:
    binding = make_binding()
    text = json.dumps(
        {"embedder_sha256": "ab" * 32, "preprocessing": dict(binding.preprocessing)},
        sort_keys=True,
        separators=(",", ":"),
    )
    assert binding.embedding_id == hashlib.sha256(text.encode()).hexdigest()
    assert dataclasses.replace(binding, m=binding.m - 1).embedding_id == binding.embedding_id
    flipped = {**binding.preprocessing, "flip": "another"}
    assert dataclasses.replace(binding, preprocessing=flipped).embedding_id != binding.embedding_id
    assert (
        dataclasses.replace(binding, embedder_sha256="ef" * 32).embedding_id != binding.embedding_id
    )


# --- the file ------------------------------------------------------------------------------


def saved(tmp_path: Path, contract: Contract | None = None) -> Path:
    path = tmp_path / "contract.json"
    (contract or make_contract()).save(path, SEALER)
    return path


def test_a_file_keeps_everything(tmp_path: Path) -> None:
    contract = make_contract()
    loaded = Contract.load(saved(tmp_path, contract), SEALER)
    assert loaded.public() == contract.public()
    assert loaded.calibrations == contract.calibrations
    assert loaded.binding == contract.binding
    assert loaded.cohort_seed == contract.cohort_seed


def test_the_file_is_private_and_alone(tmp_path: Path) -> None:
    path = saved(tmp_path)
    saved(tmp_path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [entry.name for entry in tmp_path.iterdir()] == ["contract.json"]


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path)
    before = path.read_bytes()

    def fail(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        make_contract(photo_consistency=0.5).save(path, SEALER)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_the_seed_of_the_cohort_is_sealed_and_never_public(tmp_path: Path) -> None:
    contract = make_contract()
    text = saved(tmp_path, contract).read_bytes()
    raw = text + base64.b64decode(json.loads(text)["sealed"])
    seed = contract.cohort_seed
    for form in (seed, seed.hex().encode(), base64.b64encode(seed)):
        assert form not in raw
        # Positive control: the same search finds a seed that was planted.
        assert form in raw + form
    public = json.dumps(contract.public())
    assert "sealed" not in contract.public()
    assert seed.hex() not in public
    assert "seed" not in repr(contract)


def test_nobody_is_made_once_of_the_contracts_decoys() -> None:
    source = make_source()
    contract = make_contract(binding=make_binding(decoy_source_id=source.source_id))
    assert contract.nobody(source) is contract.nobody(source)
    assert "seed" not in repr(contract.nobody(source))
    with pytest.raises(ContractMismatch, match="bound to the decoy source"):
        make_contract().nobody(source)


def test_another_master_key_does_not_open_it(tmp_path: Path) -> None:
    other = KeyringSealer(MasterKeyring([os.urandom(32)]))
    with pytest.raises(SealError, match="master key is not the one"):
        Contract.load(saved(tmp_path), other)


def reloaded(path: Path, document: Any) -> Contract:
    path.write_text(json.dumps(document))
    return Contract.load(path, SEALER)


def test_edited_thresholds_do_not_load(tmp_path: Path) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    document["calibrations"][0]["levels"][0]["score_threshold"] = -1.0
    with pytest.raises(SealError, match="the file was edited"):
        reloaded(path, document)
    # An attacker can recompute the public ids, but not the seal over them.
    edited = Calibration.from_json(document["calibrations"][0]).identified(document["contract_id"])
    document["calibrations"][0] = edited.to_json()
    with pytest.raises(SealError, match="the file was edited"):
        reloaded(path, document)


def test_formatting_may_change(tmp_path: Path) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    path.write_text(json.dumps(dict(reversed(document.items())), indent=7))
    assert Contract.load(path, SEALER).contract_id == make_contract().contract_id


MUTATIONS: list[tuple[str, Any]] = [
    ("format", "other"),
    ("version", 1),
    ("version", True),
    ("contract_id", "0" * 64),
    ("sealed", "!!!"),
    ("sealed", 3),
    ("sealed", ""),
    ("photo_consistency", "0.25"),
    ("photo_consistency", 1e400),
    ("photo_consistency", None),
    ("probe_consistency", None),
    ("template_foot_point_norm", [0.1]),
    ("template_foot_point_norm", [0.1, True]),
    ("template_stranger_similarity", "1.5"),
    ("template_stranger_similarity", 1e400),
    ("calibrations", {}),
    ("calibrations", [[]]),
    ("binding", []),
    ("binding", {}),
    ("recorded", []),
    ("recorded", {"a": {"b": {"c": {"d": {"e": {}}}}}}),
    ("recorded", {"a": "x" * 5000}),
    ("recorded", {"a": "\ud800"}),
    ("default_level", "nope"),
    ("default_level", 10**30),
    ("surprise", 1),
]


@pytest.mark.parametrize(("key", "value"), MUTATIONS)
def test_broken_files_are_refused(tmp_path: Path, key: str, value: Any) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    with pytest.raises((ContractError, SealError)):
        reloaded(path, document | {key: value})


@pytest.mark.parametrize("key", sorted(json.loads(canonical_json(make_contract().public()))))
def test_missing_keys_are_refused(tmp_path: Path, key: str) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    del document[key]
    with pytest.raises((ContractError, SealError)):
        reloaded(path, document)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"null",
        b"\xff\xfe",
        b"{",
        b'{"format": NaN}',
        b'{"format": "a", "format": "b"}',
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b'{"version": ' + b"9" * 5000 + b"}",
    ],
    ids=range(10),
)
def test_what_is_no_json_object_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "contract.json"
    path.write_bytes(data)
    with pytest.raises(ContractError):
        Contract.load(path, SEALER)


def test_size_is_bounded_before_parsing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path)
    monkeypatch.setattr(contract_module, "MAX_FILE_BYTES", path.stat().st_size - 1)
    with pytest.raises(ContractError, match="larger than"):
        Contract.load(path, SEALER)


def test_an_absent_file_names_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ContractError, match="veilface calibrate"):
        Contract.load(tmp_path / "none.json", SEALER)
    with pytest.raises(ContractError):
        Contract.load(tmp_path, SEALER)


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
    value = data.draw(json_values)
    if value == place[key]:
        return
    place[key] = value
    with pytest.raises((ContractError, SealError)):
        reloaded(path, document)


def test_a_sealed_part_that_is_no_such_part_is_refused(tmp_path: Path) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    sealed = document.pop("sealed")
    context = contract_module._seal_context(document)
    good = SEALER.open(base64.b64decode(sealed), context=context)
    for plain in (b"", good[:-1], good + b"0"):
        text = base64.b64encode(SEALER.seal(plain, context=context)).decode()
        with pytest.raises(ContractError, match="32 bytes"):
            reloaded(path, document | {"sealed": text})
    text = base64.b64encode(SEALER.seal(good, context=context)).decode()
    assert reloaded(path, document | {"sealed": text}).cohort_seed == good


def test_the_layout_of_another_version_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    with pytest.raises(ContractError, match="run `veilface calibrate` again"):
        reloaded(path, document | {"version": 2})


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
    assert contract.calibration("p2s", probe_photos=5, level="fmr-1e-2").probe_photos == 5
    assert contract.calibration("p2s", probe_photos=5, level="none").probe_photos == 5
    assert contract.calibration("s2s", None, 2, 3).probe_photos == 1
    with pytest.raises(Uncalibrated):
        contract.calibration("p2s", probe_photos=0)


def test_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        make_contract().photo_consistency = 0.0  # type: ignore[misc]


def test_a_file_of_more_values_than_any_contract_has_is_not_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    wide = tmp_path / "wide.json"
    wide.write_text(json.dumps(document | {"recorded": {"a": [[]] * MAX_PARTS}}))
    with monkeypatch.context() as patch:
        patch.setattr("templates.contract.canonical.json.loads", None)
        with pytest.raises(ContractError, match="more than 100000 values"):
            Contract.load(wide, SEALER)
    assert Contract.load(path, SEALER).contract_id == document["contract_id"]


def test_the_largest_contract_has_fewer_values_than_are_read() -> None:
    levels = tuple(
        Level(f"level-{i}", 1e-2, 2.0, RATE, RATE, dict.fromkeys(range(1, 11), RATE))
        for i in range(MAX_LEVELS)
    )
    entries = tuple(
        make_calibration(mode="s2s", probe_m=m, foot_point_norm=(0.2, 0.9), levels=levels)
        for m in range(1, MAX_CALIBRATIONS + 1)
    )
    binding = make_binding(n=MAX_CALIBRATIONS + 2, axes=MAX_CALIBRATIONS + 2)
    largest = make_contract(
        binding=binding,
        calibrations=entries,
        default_level="level-0",
        recorded={str(i): i for i in range(MAX_ITEMS)},
    )
    assert not too_many_parts(json.dumps(largest.public()).encode(), MAX_PARTS // 2)
