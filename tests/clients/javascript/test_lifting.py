"""Lifting in JavaScript: of one key Python's template, in bytes that the server reads."""

import base64
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtri

from templates.contract import wire
from templates.contract.binding import Binding
from templates.decoys import DecoyGenerator, container
from templates.decoys.statistics import MAX_COMPONENTS
from templates.errors import DecoyError, VeilfaceError
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION
from templates.space.agreement import InconsistentImages, mean_embedding, weakest_split
from templates.space.lifting import Strategy, lift
from tests.api.deployment import make_source, unit
from tests.clients.javascript.conftest import Node

CONTRACT_ID = "ab" * 32


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode()


def unb64(text: str, dtype: str) -> NDArray[Any]:
    return np.frombuffer(base64.b64decode(text), dtype)


def key_of(*parts: object) -> bytes:
    return hashlib.sha256(repr(parts).encode()).digest()


def people(count: int, n: int) -> NDArray[np.float32]:
    return unit(np.random.default_rng([count, n]).normal(size=(count, n)))


def source_of(n: int, noise: float = 0.0) -> DecoyGenerator:
    """Decoys with clusters, and with deviations that fall along the axes, as those of faces do."""
    rng = np.random.default_rng(n)
    centres = rng.normal(size=(2, n)) * 0.7
    rows = centres[rng.integers(2, size=700)] + rng.normal(size=(700, n)) * np.geomspace(2, 0.4, n)
    return DecoyGenerator.fit(unit(rows), noise=noise)


def test_draws_are_those_of_python(node: Node) -> None:
    edges = [2.0**-53, 1e-300, 1e-20, 1e-9, 0.02, 0.1353, 0.13534, 0.5, 0.8646, 0.8647, 0.999999]
    key = key_of("draws")
    quantiles, draws = node(
        "lift.js",
        [
            {"call": "quantiles", "probabilities": edges},
            {"call": "draws", "key": b64(key), "count": 5000},
        ],
    )
    np.testing.assert_allclose(quantiles["value"], ndtri(edges), rtol=1e-13, atol=1e-15)
    uniform, normal, signed = (unb64(text, "<f8") for text in draws["value"])
    stream = Keystream(key)
    assert np.array_equal(uniform, stream.uniform(5000))
    np.testing.assert_allclose(normal, stream.normal(5000), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(signed, stream.uniform(5000, -1.0, 1.0), rtol=0, atol=1e-15)


def compare_lifts(
    node: Node, source: DecoyGenerator, cases: list[tuple[Strategy, int]], descriptor: Any
) -> float:
    """Hold lifts of one key against Python's; return the largest difference of a number."""
    questions = [
        {
            "call": "lift",
            "key": b64(key_of(str(strategy), m, source.n)),
            "descriptor": b64(np.asarray(descriptor, "<f4").tobytes()),
            "generator": b64(source.to_bytes()),
            "strategy": str(strategy),
            "m": m,
            "contract_id": CONTRACT_ID,
        }
        for strategy, m in cases
    ]
    worst = 0.0
    for (strategy, m), answer in zip(cases, node("lift.js", questions), strict=True):
        ours = answer["value"]
        assert ours["source_id"] == source.source_id
        stream = Keystream(key_of(str(strategy), m, source.n))
        theirs = lift(descriptor[None], strategy=strategy, m=m, source=source, stream=stream)[0]
        foot, basis = unb64(ours["foot"], "<f4"), unb64(ours["basis"], "<f4").reshape(m, source.n)
        worst = max(
            worst,
            float(np.abs(foot - theirs.foot).max()),
            float(np.abs(basis - theirs.basis).max()),
        )
        decoded = wire.decode(base64.b64decode(ours["wire"]))
        assert decoded.contract_id == CONTRACT_ID
        assert decoded.dtype == "float16"
        # The bytes are those that Python would write of the same numbers.
        assert base64.b64decode(ours["wire"]) == wire.encode(
            type(theirs)(foot, basis), contract_id=CONTRACT_ID
        )
    return worst


@pytest.mark.parametrize("noise", [0.0, 0.1 / 64])
def test_lifts_of_one_key_are_those_of_python(node: Node, noise: float) -> None:
    source = source_of(64, noise)
    cases = [(Strategy.ADVERSARIAL, 8), (Strategy.ADVERSARIAL, 40), (Strategy.HYBRID, 9)]
    cases += [(Strategy.RANDOM, 4), (Strategy.ADVERSARIAL, 1)]
    assert compare_lifts(node, source, cases, people(1, 64)[0]) < 1e-6


@pytest.mark.long
def test_lifts_of_a_real_dimension(node: Node, shared_data: Path) -> None:
    """Decoys of real faces, m = 160 as recommended contracts have it."""
    rows = np.load(shared_data / "embeddings" / "lfw_rest.npz")["emb_mbf"].astype(np.float32)
    source = DecoyGenerator.fit(unit(rows[:3000]), noise=0.1 / 512)
    cases = [(Strategy.ADVERSARIAL, m) for m in (4, 32, 160)]
    assert compare_lifts(node, source, cases, unit(rows[5000:5001])[0]) < 1e-6


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
    strategy=Strategy.ADVERSARIAL,
    m=8,
    decoy_source_id=make_source().source_id,
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
    """Without a key of the test: each template is another, and contains the descriptor."""
    rows = unit(people(1, 64) + 0.05 * people(3, 64))
    shared = {
        "contract": public(),
        "generator": b64(make_source().to_bytes()),
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
        assert decoded.subspace.contains(mean[None], tol=2e-3).all()


def test_contracts_and_generators_that_hide_nothing_are_refused(node: Node) -> None:
    generator = make_source().to_bytes()
    flat = bytearray(generator)
    # The last numbers of the axes' tensor: the axes are not orthogonal then.
    start = 8 + int.from_bytes(flat[:8], "little")
    flat[start + 256 : start + 512] = flat[start : start + 256]
    narrow = _narrow()
    altered = public()
    altered["binding"] = {**altered["binding"], "m": 3}
    cases: list[tuple[dict[str, Any], bytes, str]] = [
        (altered, generator, "ContractError"),
        (public(), source_of(64).to_bytes(), "ContractError"),
        (public(), bytes(flat), "DecoyError"),
        (public(), narrow, "DecoyError"),
        (public(), generator[:-4], "DecoyError"),
        (public(), b"\xff" * 64, "DecoyError"),
        (public(calibrations=[]), generator, "ContractError"),
    ]
    questions = [
        {
            "call": "template",
            "contract": document,
            "generator": b64(data),
            "embeddings": [b64(people(1, 64)[0].tobytes())],
            "probe": True,
        }
        for document, data, _ in cases
    ]
    answers = node("lift.js", questions)
    assert [answer.get("error") for answer in answers] == [error for *_, error in cases]
    for data in (bytes(flat), narrow):
        with pytest.raises(VeilfaceError):
            DecoyGenerator.from_bytes(data)


def _narrow() -> bytes:
    """A generator whose decoys lie in few dimensions: the first axes are a million times longer."""
    data = bytearray(make_source().to_bytes())
    start = 8 + int.from_bytes(data[:8], "little")
    axes = np.frombuffer(bytes(data[start : start + 4 * 64 * 64]), "<f4").reshape(64, 64).copy()
    axes[4:] *= 1e-6
    data[start : start + 4 * 64 * 64] = axes.tobytes()
    return bytes(data)


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
        try:
            expected = mean_embedding(one, consistency=0.5)
        except InconsistentImages:
            split = weakest_split(one)
            assert answer["error"] == "InconsistentImages"
            assert (answer["apart"], answer["others"]) == (list(split.apart), list(split.others))
        else:
            np.testing.assert_allclose(unb64(answer["value"], "<f4"), expected, atol=1e-6)


def hostile_generators() -> dict[str, bytes]:
    """Bytes of a generator of 70 dimensions in which one thing is wrong, by what that is."""
    good = source_of(70).to_bytes()
    decoded, arrays = container.decode(good, what="generator", max_bytes=len(good))
    fields: dict[str, Any] = dict(decoded)
    centres = arrays["centres"]
    energy = np.array(centres)
    energy[0, -1] = 11.0
    unlike = np.array(arrays["axes"])
    unlike[1] = unlike[0]
    few = np.array(arrays["axes"])
    few[4:] *= 1e-5

    def altered(**parts: NDArray[Any]) -> bytes:
        return container.encode(fields, {**arrays, **parts})

    def weighted(weights: NDArray[Any]) -> bytes:
        count = len(weights)
        return altered(
            weights=weights.astype(np.float32),
            centres=np.repeat(centres[:1], count, axis=0),
            spreads=np.repeat(arrays["spreads"][:1], count, axis=0),
        )

    def said(**more: Any) -> bytes:
        return container.encode({**fields, **more}, arrays)

    size = int.from_bytes(good[:8], "little")
    header, body = good[8 : 8 + size], good[8 + size :]

    def headed(text: bytes) -> bytes:
        return len(text).to_bytes(8, "little") + text + body

    return {
        "a log energy": altered(centres=energy),
        "components": weighted(np.full(MAX_COMPONENTS + 1, 1 / (MAX_COMPONENTS + 1))),
        "a number that is not finite": altered(mean=np.full(70, np.nan, np.float32)),
        "a large number": altered(mean=np.full(70, 2e3, np.float32)),
        "no length": altered(axes=np.zeros((70, 70), np.float32)),
        "weights that add up to 2": weighted(np.ones(2)),
        "a weight of 0": weighted(np.eye(2)[0]),
        "axes that are not orthogonal": altered(axes=unlike),
        "decoys in few dimensions": altered(axes=few),
        "centres that do not fit": altered(centres=centres[:, :-1]),
        "one dimension": altered(mean=np.zeros(1, np.float32)),
        "another part": altered(more=np.zeros(1, np.float32)),
        "a shape of another rank": altered(mean=arrays["mean"][None]),
        "bytes as numbers": altered(mean=np.zeros(70, np.uint8)),
        "another version": said(version=2),
        "another field": said(more="field"),
        "a made_with that is no hash": said(made_with="ab"),
        "a noise that is too large": said(noise="0.2"),
        "a noise that is a number": said(noise=0),
        "a noise in another writing": said(noise="1e-5"),
        "bytes behind": good + b"\0",
        "bytes that lack": good[:-1],
        "a header that is padded": headed(header + b" " * 8),
        "a header with a mark": headed(b"\xef\xbb\xbf" + header),
        "a part twice": headed(header.rstrip()[:-1] + b',"mean":' + b"{}}"),
        "a header that is too large": headed(header + b" " * 2**16),
        "no header": b"\xff" * 8 + body,
    }


def test_generators_that_python_refuses_are_refused(node: Node) -> None:
    hostile = hostile_generators()
    for data in hostile.values():
        with pytest.raises(DecoyError):
            DecoyGenerator.from_bytes(data)
    noises = [0.0, 1.5e-07, 2.5e-05, 1e-4, 0.0125, 0.1]
    good = [source_of(70, noise).to_bytes() for noise in noises]
    answers = node(
        "lift.js",
        [{"call": "read", "generator": b64(data)} for data in (*hostile.values(), *good)],
    )
    for what, answer in zip(hostile, answers, strict=False):
        assert answer.get("error") == "DecoyError", what
    assert [answer.get("value") for answer in answers[len(hostile) :]] == noises
