"""Lifting in JavaScript: what Python's lifts hold and hide, in bytes that the server reads."""

import base64
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import kstest

from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator, container
from templates.errors import DecoyError
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.agreement import InconsistentImages, mean_embedding
from templates.space.lifting import Strategy
from templates.space.subspace import SubspaceBatch
from tests.clients.javascript.conftest import Node

CONTRACT_ID = "ab" * 32


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def unb64(text: str, dtype: str) -> NDArray[Any]:
    return np.frombuffer(base64.b64decode(text), dtype)


def unit(rows: NDArray[np.floating]) -> NDArray[np.float32]:
    return (rows / np.linalg.norm(rows, axis=-1, keepdims=True)).astype(np.float32)


def people(count: int, n: int) -> NDArray[np.float32]:
    return unit(np.random.default_rng([count, n]).normal(size=(count, n)))


def source_of(n: int, k: int) -> DecoyGenerator:
    """Decoys with a mean, and with deviations that fall along the axes, as those of faces do."""
    rng = np.random.default_rng(n)
    mean = rng.normal(size=n) * 0.7
    return DecoyGenerator.fit(
        unit(mean + rng.normal(size=(700, n)) * np.geomspace(2, 0.4, n))
    ).reduced(k)


SOURCE = source_of(64, 40)
"""Of 64 numbers and 40 axes."""


def test_samples_have_their_distributions(node: Node) -> None:
    """At a level that one run in a million misses: the bits are the platform's own."""
    (answer,) = node("lift.js", [{"call": "draws", "count": 20_000}])
    uniform, normal = (unb64(text, "<f8") for text in answer["value"])
    assert kstest(uniform, "uniform", args=(-1, 2)).pvalue > 1e-6
    assert kstest(normal, "norm").pvalue > 1e-6
    neighbours = np.corrcoef(normal[:-1], normal[1:])[0, 1]
    assert abs(neighbours) < 5 / np.sqrt(len(normal))


def test_embeddings_are_projected_as_python_does(node: Node) -> None:
    embedding = people(1, 64)[0]
    wrong = [2 * embedding, embedding[:-1], np.full(64, np.nan, np.float32)]
    questions = [
        {"call": "project", "generator": b64(SOURCE.to_bytes()), "embedding": b64(row.tobytes())}
        for row in (embedding, *wrong)
    ]
    right, *refused = node("lift.js", questions)
    projected = unb64(right["value"], "<f8")
    np.testing.assert_allclose(projected, SOURCE.project(embedding[None])[0], atol=1e-6)
    assert [answer.get("code") for answer in refused] == ["unusable_contract"] * 3


def test_decoys_have_the_moments_of_those_of_python(node: Node) -> None:
    """Along every principal axis of Python's own, within six standard errors."""
    count = 8000
    (answer,) = node(
        "lift.js",
        [{"call": "decoys", "generator": b64(SOURCE.to_bytes()), "count": count}],
    )
    ours = unb64(answer["value"], "<f4").reshape(count, SOURCE.k).astype(np.float64)
    np.testing.assert_allclose(np.linalg.norm(ours, axis=1), 1, atol=1e-6)
    stream = Keystream.seeded("decoys")
    theirs = SOURCE.draw(1, 20 * count, stream=stream)[0].astype(np.float64)
    mean = theirs.mean(axis=0)
    variances, axes = np.linalg.eigh(np.cov(theirs, rowvar=False))
    deviations = (ours - mean) @ axes / np.sqrt(variances)
    assert np.abs(deviations.mean(axis=0)).max() < 6 / np.sqrt(count)
    squares = np.cov(deviations, rowvar=False) - np.eye(SOURCE.k)
    assert np.abs(np.diag(squares)).max() < 6 * np.sqrt(2 / count)
    assert np.abs(squares - np.diag(np.diag(squares))).max() < 6 / np.sqrt(count)


def check_lifts(
    node: Node, source: DecoyGenerator, cases: list[tuple[Strategy, int]], embedding: Any
) -> None:
    """Each holds the embedding's projection, is orthonormal, and is read by the server."""
    questions = [
        {
            "call": "lift",
            "embedding": b64(np.asarray(embedding, "<f4").tobytes()),
            "generator": b64(source.to_bytes()),
            "strategy": str(strategy),
            "m": m,
            "contract_id": CONTRACT_ID,
        }
        for strategy, m in cases
    ]
    point = source.project(embedding[None])
    for (_, m), answer in zip(cases, node("lift.js", questions), strict=True):
        ours = answer["value"]
        foot, basis = unb64(ours["foot"], "<f4"), unb64(ours["basis"], "<f4").reshape(m, source.k)
        np.testing.assert_allclose(basis @ basis.T, np.eye(m), atol=1e-6)
        np.testing.assert_allclose(basis @ foot, 0, atol=1e-6)
        template = SubspaceBatch(foot, basis)
        assert template.contains(point, tol=1e-5).all()
        decoded = wire.decode(base64.b64decode(ours["wire"]))
        assert decoded.contract_id == CONTRACT_ID
        assert decoded.dtype == "float16"
        # The bytes are those that Python would write of the same numbers.
        assert base64.b64decode(ours["wire"]) == wire.encode(template, contract_id=CONTRACT_ID)


def test_lifts_hold_the_projection(node: Node) -> None:
    cases = [(Strategy.ADVERSARIAL, 8), (Strategy.ADVERSARIAL, 32), (Strategy.HYBRID, 9)]
    cases += [(Strategy.RANDOM, 4), (Strategy.ADVERSARIAL, 1)]
    check_lifts(node, SOURCE, cases, people(1, 64)[0])


BINDING = Binding(
    embedder_sha256="5e" * 32,
    preprocessing={
        "version": 2,
        "alignment": "arcface-112",
        "size": 112,
        "channel_order": "rgb",
        "mean": [123.675, 116.28, 103.53],
        "scale": [127.5, 127.5, 128.0],
        "flip": True,
    },
    n=64,
    axes=40,
    strategy=Strategy.ADVERSARIAL,
    m=8,
    decoy_source_id=SOURCE.source_id,
    rotation_version=ROTATION_VERSION,
)


def public(**changes: Any) -> dict[str, Any]:
    """What ``GET /v1/contract`` answers, as far as a client reads it."""
    return {
        "contract_id": BINDING.contract_id,
        "binding": BINDING.to_json(),
        "recorded": {},
        "calibrations": [{"mode": "p2s", "probe_m": 0}, {"mode": "s2s", "probe_m": 2}],
        "photo_consistency": 0.2,
        "probe_consistency": 0.1,
        **changes,
    }


def test_templates_hold_the_mean_and_no_key_twice(node: Node) -> None:
    """Each template is another, and contains the projection of the mean."""
    rows = unit(people(1, 64) + 0.05 * people(3, 64))
    shared = {
        "contract": public(),
        "generator": b64(SOURCE.to_bytes()),
        "embeddings": [b64(row.tobytes()) for row in rows],
    }
    questions = [{"call": "template", "probe": probe, **shared} for probe in (False, False, True)]
    templates = [base64.b64decode(answer["value"]) for answer in node("lift.js", questions)]
    assert templates[0] != templates[1]
    mean = mean_embedding(rows, consistency=0.2)
    for data, m in zip(templates, (BINDING.m, BINDING.m, 2), strict=True):
        decoded = wire.decode(data)
        assert decoded.contract_id == BINDING.contract_id
        assert decoded.subspace.m == m
        assert decoded.subspace.contains(SOURCE.project(mean[None]), tol=2e-3).all()


def test_contracts_and_generators_that_hide_nothing_are_refused(node: Node) -> None:
    generator = SOURCE.to_bytes()
    altered = public()
    altered["binding"] = {**altered["binding"], "m": 3}
    cases: list[tuple[dict[str, Any], bytes]] = [
        (altered, generator),
        (public(), source_of(64, 64).to_bytes()),
        (public(calibrations=[]), generator),
    ]
    questions = [
        {
            "call": "template",
            "contract": document,
            "generator": b64(data),
            "embeddings": [b64(people(1, 64)[0].tobytes())],
            "probe": True,
        }
        for document, data in cases
    ]
    answers = node("lift.js", questions)
    assert [answer.get("code") for answer in answers] == ["unusable_contract"] * len(cases)


def test_photos_of_two_people_are_told_as_python_tells_them(node: Node) -> None:
    rows = people(5, 64)
    sets = [
        unit(rows[[0, 0, 1]] + 0.1 * people(3, 64)),
        unit(rows[[0, 0, 1, 1, 1]] + 0.1 * people(5, 64)),
        rows[:2],
        unit(rows[[2, 2, 2, 2]] + 0.1 * people(4, 64)),
    ]
    questions = [
        {"call": "mean", "embeddings": [b64(row.tobytes()) for row in one], "consistency": 0.5}
        for one in sets
    ]
    for one, answer in zip(sets, node("lift.js", questions), strict=True):
        if "code" not in answer:
            expected = mean_embedding(one, consistency=0.5)
            np.testing.assert_allclose(unb64(answer["value"], "<f4"), expected, atol=1e-6)
            continue
        with pytest.raises(InconsistentImages):
            mean_embedding(one, consistency=0.5)
        assert answer["code"] == "inconsistent_images"


def hostile_generators() -> dict[str, bytes]:
    """Bytes of a generator of 70 axes in which one thing is wrong, by what that is."""
    good = source_of(72, 70).to_bytes()
    decoded, arrays = container.decode(good, what="generator", max_bytes=len(good))
    fields: dict[str, Any] = dict(decoded)
    axes, mean, root = (np.array(arrays[name]) for name in ("axes", "mean", "root"))
    alike = axes.copy()
    alike[:, 1] = alike[:, 0]
    upper = root.copy()
    upper[0, 1] = 1e-3
    few = root.copy()
    few[4:] *= 1e-5

    def altered(**parts: NDArray[Any]) -> bytes:
        return container.encode(fields, {**arrays, **parts})

    return {
        "a number that is not finite": altered(mean=np.full(70, np.nan, np.float32)),
        "a large mean": altered(mean=np.full(70, 2e3, np.float32)),
        "axes that are not orthonormal": altered(axes=alike),
        "axes that are too long": altered(axes=axes * np.float32(1.01)),
        "a root with a part above": altered(root=upper),
        "a root of another sign": altered(root=-root),
        "decoys along few axes": altered(root=few),
        "more axes than numbers": altered(axes=axes[:69]),
        "a mean that does not fit": altered(mean=mean[:-1]),
        "another part": altered(more=np.zeros(1, np.float32)),
        "bytes as numbers": altered(mean=np.zeros(70, np.uint8)),
        "another version": container.encode({**fields, "version": 1}, arrays),
        "another field": container.encode({**fields, "noise": "0.0"}, arrays),
        "a made_with that is no hash": container.encode({**fields, "made_with": "ab"}, arrays),
        "bytes behind": good + b"\0",
        "bytes that lack": good[:-1],
        "no header": b"\xff" * 64,
    }


def test_generators_that_python_refuses_are_refused(node: Node) -> None:
    hostile = hostile_generators()
    for data in hostile.values():
        with pytest.raises(DecoyError):
            DecoyGenerator.from_bytes(data)
    good = [SOURCE, source_of(72, 70), source_of(8, 2), source_of(8, 8)]
    good.append(DecoyGenerator(SOURCE.axes, SOURCE.mean, SOURCE.root, made_with="5e" * 32))
    sent = [*hostile.values(), *(source.to_bytes() for source in good)]
    answers = node("lift.js", [{"call": "read", "generator": b64(data)} for data in sent])
    for what, answer in zip(hostile, answers, strict=False):
        assert answer.get("code") == "unusable_contract", what
    assert [answer.get("value") for answer in answers[len(hostile) :]] == [
        {"n": source.n, "k": source.k, "source_id": source.source_id} for source in good
    ]
