"""The contract: ids, the file, and everything that must not pass as a file."""

import base64
import dataclasses
import errno
import functools
import hashlib
import json
import os
import stat
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
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
from templates.contract.expectation import PointExpectation
from templates.contract.levels import MAX_LEVELS
from templates.contract.nobody import Nobody
from templates.decoys import DecoyGenerator
from templates.distances import Metric
from templates.errors import ContractError, ContractMismatch, SealError, Uncalibrated
from templates.keys.rotation import HAAR_VERSION, ROTATION_VERSION
from templates.keys.sealing import KeyringSealer, MasterKeyring
from templates.space.lifting import Strategy
from templates.space.rounded import RoundedBatch
from verify.strangers import STRANGERS

N, M = 16, 3
SEALER = KeyringSealer(MasterKeyring([os.urandom(32)]))
RATE = Rate(errors=2, trials=1000, ci_low=0.0005, ci_high=0.007)


def make_binding(**changes: Any) -> Binding:
    fields: dict[str, Any] = {
        "embedder_sha256": "ab" * 32,
        "preprocessing": {"size": 112, "mean": (127.5, 127.5, 127.5), "flip": False},
        "n": N,
        "strategy": Strategy.RANDOM,
        "m": M,
        "decoy_source_id": "cd" * 32,
        "rotation_version": ROTATION_VERSION,
    }
    return Binding(**{**fields, **changes})


@functools.cache
def make_nobody(n: int = N, *, seed: int = 0) -> Nobody:
    rows = np.random.default_rng(4).normal(size=(200, n)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return Nobody.of(rows[:6], DecoyGenerator.fit(rows), seed=bytes([seed]) * 32)


@functools.cache
def make_expectation(n: int = N, m: int = M) -> PointExpectation:
    """That of templates in all directions alike: √(m/n), with a spread of 0.1."""
    return PointExpectation(
        metric=Metric.SPHERICAL,
        projector=np.eye(n, dtype=np.float32) * np.float32(m / n),
        foot=np.zeros(n, dtype=np.float32),
        mean=np.array([1.0, 0, 0, 0, 0, 0]),
        log_spread=np.array([0, 0, 0, 0, 0, np.log(0.1)]),
    )


def changed(**fields: Any) -> PointExpectation:
    return dataclasses.replace(make_expectation(), **fields)


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
        "template_stranger_score": 1.5,
        "expectation": make_expectation(),
        "nobody": make_nobody(),
    }
    return Contract(**{**fields, **changes})


# --- ids -----------------------------------------------------------------------------------


def test_contract_id_is_the_hash_of_the_canonical_json() -> None:
    written = (
        '{"decoy_source_id":"' + "cd" * 32 + '","embedder_sha256":"' + "ab" * 32 + '","m":3,"n":16,'
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
        {"strategy": Strategy.HYBRID},
        {"m": 4},
        {"decoy_source_id": "ce" * 32},
        {"rotation_version": "2"},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_part_of_the_binding_changes_the_id(changes: dict[str, Any]) -> None:
    assert make_binding(**changes).contract_id != make_binding().contract_id


def test_templates_of_the_earlier_rotation_version_are_served_and_no_others() -> None:
    binding = make_binding()
    earlier = make_binding(rotation_version=HAAR_VERSION)
    assert binding.contract_ids == (binding.contract_id, earlier.contract_id)
    for served in (binding, earlier):
        version = binding.require_contract(served.contract_id, what="the template")
        assert version == served.rotation_version
    for other in ({"m": 4}, {"rotation_version": "2"}, {"m": 4, "rotation_version": HAAR_VERSION}):
        with pytest.raises(ContractMismatch, match="the template belongs to the contract"):
            binding.require_contract(make_binding(**other).contract_id, what="the template")
    # Nothing is served the other way round.
    assert earlier.contract_ids == (earlier.contract_id,)


def test_a_contract_of_the_earlier_rotation_version_is_refused_with_the_remedy() -> None:
    make_binding().require_rotation_version()
    with pytest.raises(
        ContractMismatch, match=r"'haar-1'.* run `veilface calibrate --strategy"
    ) as no:
        make_binding(rotation_version=HAAR_VERSION).require_rotation_version()
    assert f"--strategy {make_binding().strategy} --dim {make_binding().m}`" in str(no.value)


def test_recalibrating_keeps_the_contract_id_and_changes_the_calibration_id() -> None:
    first = make_contract()
    levels = (Level("fmr-1e-2", 1e-2, 2.1, RATE, RATE),)
    again = make_contract(calibrations=(make_calibration(levels=levels),))
    others = [
        make_contract(nobody=make_nobody(seed=1)),
        make_contract(expectation=changed(mean=np.array([1.0, 0, 0, 0, 0, 1e-9]))),
        make_contract(expectation=changed(projector=make_expectation(m=M + 1).projector)),
    ]
    ids = {entry.calibrations[0].calibration_id for entry in (first, again, *others)}
    assert len(ids) == 5
    assert len({entry.contract_id for entry in (first, again, *others)}) == 1
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
        {"template_stranger_score": float("nan")},
        {"nobody": dataclasses.replace(make_nobody(), halves=make_nobody().halves[:1])},
        {"nobody": dataclasses.replace(make_nobody(), halves=2 * make_nobody().halves)},
        {"nobody": dataclasses.replace(make_nobody(), halves=np.nan * make_nobody().halves)},
        {"nobody": dataclasses.replace(make_nobody(), seed=b"short")},
        {"nobody": make_nobody(N + 1)},
        {"default_level": "fmr-1e-9"},
        {"calibrations": ()},
        {"calibrations": (make_calibration(), make_calibration(steps=9))},
        {"calibrations": (make_calibration(calibration_id="0" * 64),)},
        {"expectation": make_expectation(N + 1)},
        {"expectation": changed(metric=Metric.EUCLIDEAN)},
        {"expectation": changed(foot=np.full(N, np.nan, dtype=np.float32))},
        {"expectation": changed(foot=np.full(N, 1.1, dtype=np.float32))},
        {"expectation": changed(projector=np.triu(np.full((N, N), 0.1, dtype=np.float32)))},
        {"expectation": changed(mean=np.full(6, np.inf))},
        {"expectation": changed(mean=np.full(6, 1e7))},
        {"expectation": changed(log_spread=np.zeros(5))},
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
    assert loaded.nobody_id == contract.nobody_id
    np.testing.assert_array_equal(loaded.nobody.people, contract.nobody.people)
    np.testing.assert_array_equal(loaded.expectation.projector, contract.expectation.projector)
    points = contract.nobody.people
    np.testing.assert_array_equal(
        loaded.expectation.statistics(points), contract.expectation.statistics(points)
    )
    # Lifted from the seed, and not kept in the file.
    np.testing.assert_array_equal(loaded.cohort.feet, contract.cohort.feet)
    np.testing.assert_array_equal(loaded.cohort.numbers, contract.cohort.numbers)


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


def test_strangers_and_seed_are_sealed_and_never_public(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    contract = make_contract()
    text = saved(tmp_path, contract).read_bytes()
    with monkeypatch.context() as context:
        context.setattr("templates.contract.nobody.RoundedBatch.of", lambda lifted: lifted)
        unrounded = make_contract().cohort
    patterns = [
        array[0].astype(dtype).tobytes()
        for array in (unrounded.feet, unrounded.bases, contract.nobody.people)
        for dtype in ("<f4", "<f2", "<f8")
    ] + [contract.cohort.numbers[0].tobytes(), contract.nobody.seed]
    raw = text + base64.b64decode(json.loads(text)["sealed"])
    assert not any(pattern in raw for pattern in patterns)
    # Positive control: the same search finds a number that was planted.
    assert any(pattern in raw + contract.cohort.feet.tobytes() for pattern in patterns)
    public = json.dumps(contract.public())
    assert "sealed" not in contract.public()
    assert repr(float(contract.nobody.people[0, 0])) not in public
    assert contract.nobody.seed.hex() not in public
    assert "nobody=" not in repr(contract)
    assert repr(contract.nobody).startswith("<")


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
    edited = Calibration.from_json(document["calibrations"][0]).identified(
        contract_id=document["contract_id"], nobody_id=document["nobody_id"]
    )
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
    ("nobody_id", "0" * 64),
    ("photo_consistency", "0.25"),
    ("photo_consistency", 1e400),
    ("photo_consistency", None),
    ("probe_consistency", None),
    ("template_foot_point_norm", [0.1]),
    ("template_foot_point_norm", [0.1, True]),
    ("template_stranger_score", "1.5"),
    ("template_stranger_score", 1e400),
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
    whole = safetensors.numpy.load(good)

    def with_(name: str, array: Any) -> bytes:
        return safetensors.numpy.save(whole | {name: np.ascontiguousarray(array)})

    triangle, axes = whole["expectation.projector"], whole["nobody.axes"]
    for plain in (
        b"",
        good[:-1],
        safetensors.numpy.save({"nobody.people": whole["nobody.people"]}),
        with_("more", triangle),
        with_("nobody.people", whole["nobody.people"].astype(np.float32)),
        with_("nobody.people", whole["nobody.people"][0]),
        with_("nobody.people", whole["nobody.people"][:5]),
        with_("nobody.seed", whole["nobody.seed"][:-1]),
        with_("nobody.seed", whole["nobody.seed"].astype(np.float32)),
        with_("nobody.axes", axes[:-1]),
        with_("nobody.axes", np.full_like(axes, np.inf)),
        with_("expectation.projector", triangle[:-1]),
        with_("expectation.projector", triangle.astype(np.float16)),
        with_("expectation.projector", np.full_like(triangle, 3e38)),
        with_("expectation.foot", np.float32(1)),
        with_("expectation.mean", whole["expectation.mean"][:-1]),
        with_("expectation.log_spread", np.full(6, np.nan)),
        with_("expectation.metric", np.frombuffer(b"cosine", dtype=np.uint8)),
        with_("expectation.metric", np.frombuffer(b"euclidean", dtype=np.uint8)),
        # Sound, but not what the rest of the document names.
        with_("expectation.foot", whole["expectation.foot"] + np.float32(1e-3)),
        with_("nobody.seed", whole["nobody.seed"] + np.uint8(1)),
    ):
        text = base64.b64encode(SEALER.seal(plain, context=context)).decode()
        with pytest.raises(ContractError):
            reloaded(path, document | {"sealed": text})
    text = base64.b64encode(SEALER.seal(good, context=context)).decode()
    assert reloaded(path, document | {"sealed": text}).nobody_id == document["nobody_id"]


def test_the_layout_of_an_earlier_version_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = saved(tmp_path)
    document = json.loads(path.read_text())
    level = document["calibrations"][0]["levels"][0]
    level |= {"similarity_threshold": 0.35, "cohort_threshold": level.pop("score_threshold")}
    earlier = document | {"cohort": document["sealed"], "cohort_size": 400, "cohort_id": "0" * 64}
    del earlier["sealed"], earlier["nobody_id"]
    for old in (earlier, document | {"version": 1}):
        with pytest.raises(ContractError, match="run `veilface calibrate` again"):
            reloaded(path, old)


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


def test_a_contract_of_faces_takes_less_than_three_megabytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n, m = 512, 64
    rows = rng.normal(size=(600, n)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    people = np.concatenate([rows, -rows[:400]])
    levels = tuple(
        Level(f"fmr-1e-{k}", 10.0**-k, 3.0, RATE, RATE, {1: RATE, 2: RATE, 3: RATE})
        for k in range(2, 7)
    )
    square = rng.normal(size=(n, n)).astype(np.float32) / 100
    contract = make_contract(
        binding=make_binding(n=n, m=m),
        calibrations=(
            *(make_calibration(levels=levels, probe_photos=photos) for photos in (1, 2, 3, 5)),
            *(make_calibration(**LIFTED | {"probe_m": k}, levels=levels) for k in (2, 4, 8, 16)),
        ),
        expectation=dataclasses.replace(make_expectation(n, m), projector=square + square.T),
        nobody=Nobody.of(people, DecoyGenerator.fit(rows), seed=bytes(32)),
    )
    assert len(people) == STRANGERS
    assert saved(tmp_path, contract).stat().st_size < 3_000_000


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
    binding = make_binding(n=MAX_CALIBRATIONS + 2)
    largest = make_contract(
        binding=binding,
        calibrations=entries,
        expectation=make_expectation(binding.n),
        nobody=make_nobody(binding.n),
        default_level="level-0",
        recorded={str(i): i for i in range(MAX_ITEMS)},
    )
    assert not too_many_parts(json.dumps(largest.public()).encode(), MAX_PARTS // 2)


def test_one_thread_lifts_the_cohort(monkeypatch: pytest.MonkeyPatch) -> None:
    """From Python 3.12 on a cached property has no lock of its own."""
    contract = make_contract()
    lift, lifts = Nobody.cohort, []
    asked = threading.Barrier(4)

    def slowly(*args: Any, **options: Any) -> RoundedBatch:
        lifts.append(threading.get_ident())
        time.sleep(0.2)  # The others ask meanwhile.
        return lift(*args, **options)

    def ask() -> None:
        asked.wait()
        seen.append(contract.cohort)

    seen: list[RoundedBatch] = []
    monkeypatch.setattr(Nobody, "cohort", slowly)
    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(lifts) == 1
    assert len(seen) == 4
    assert all(each is seen[0] for each in seen)
