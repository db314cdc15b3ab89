import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from templates.contract.wire import (
    MAX_BYTES,
    MAX_HEADER_BYTES,
    WireDtype,
    decode,
    decode_as_stored,
    encode,
    encoded_size,
)
from templates.distances import Metric, paired_distances, pairwise_distances
from templates.errors import InvalidTemplate
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch

CONTRACT = "0123456789abcdef" * 4
DTYPES: tuple[WireDtype, ...] = ("float16", "float32")


def template(n: int = 24, m: int = 5, seed: int = 0) -> SubspaceBatch:
    stream = Keystream.seeded("wire", seed)
    descriptor = stream.normal((1, n))
    descriptor /= np.linalg.norm(descriptor)
    return lift(descriptor, strategy="random", m=m, stream=stream)[0]


def packed(header: object, payload: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + payload


def parts(data: bytes) -> tuple[dict, bytes]:
    length = struct.unpack("<Q", data[:8])[0]
    return json.loads(data[8 : 8 + length]), data[8 + length :]


@pytest.mark.parametrize("metric", Metric)
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_point_is_as_far_from_a_template_as_it_was_stored(dtype: WireDtype, metric: Metric):
    """The rounding of the wire is allowed for where it was not removed."""
    point = Keystream.seeded("as stored").normal((1, 512))
    point /= np.linalg.norm(point)
    member = SubspaceBatch.through(
        point[0], Keystream.seeded("decoys").normal((160, 512)), stream=Keystream.seeded("set")
    )
    for made in (member, template(512, 160)):
        data = encode(made, contract_id=CONTRACT, dtype=dtype)
        read, stored = decode(data).subspace, decode_as_stored(data).subspace
        if dtype == "float16":
            assert np.abs(stored.basis @ stored.basis.T - np.eye(160)).max() > 3e-5
        near, far = (
            paired_distances(point, side, metric=metric, as_stored=side is stored)
            for side in (stored, read)
        )
        np.testing.assert_allclose(near, far, atol=2e-7)


@given(
    n=st.integers(2, 60),
    m_part=st.floats(0, 1),
    dtype=st.sampled_from(DTYPES),
    seed=st.integers(0, 10**6),
)
def test_round_trip_keeps_the_set(n: int, m_part: float, dtype: WireDtype, seed: int):
    m = 1 + int(m_part * (n - 2))
    original = template(n, m, seed)
    data = encode(original, contract_id=CONTRACT, dtype=dtype)
    assert len(data) == encoded_size(n, m, dtype)
    read = decode(data)
    assert (read.contract_id, read.dtype) == (CONTRACT, dtype)
    read.subspace.validate(1e-6)
    # The projections on both sets, which do not depend on the basis.
    points = Keystream.seeded(seed, "points").normal((4, n))
    atol = {"float16": 2e-3, "float32": 1e-6}[dtype] * np.sqrt(m) * np.abs(points).max()
    np.testing.assert_allclose(
        read.subspace.project(points), original.project(points), atol=4 * atol
    )


@pytest.mark.parametrize("m", [3, 192])
def test_rows_at_the_edge_of_the_tolerance_are_orthonormalised(m: int):
    """Many rows that all lean the same way are further from orthonormal than any pair of them."""
    n, lean = 400, 1.8e-3
    rows = np.linalg.qr(np.random.default_rng(m).standard_normal((n, m + 1)))[0].T
    gram = (1 - lean) * np.eye(m) + lean
    leaning = np.linalg.cholesky(gram) @ rows[1:]
    tensors = {"foot": (0.4 * rows[0]).astype("<f2"), "basis": leaning.astype("<f2")}
    metadata = {"format": "veilface-template", "version": "1", "contract_id": CONTRACT}
    data = safetensors.numpy.save(tensors, metadata=metadata)
    basis = decode(data).subspace.basis.astype(np.float64)
    np.testing.assert_allclose(basis @ basis.T, np.eye(m), atol=1e-6)
    np.testing.assert_allclose(basis.T @ basis, rows[1:].T @ rows[1:], atol=2e-3)


@pytest.mark.parametrize(("m", "near_zero"), [(4, 1e-3), (16, 4e-4)])
def test_float16_moves_distances_by_little(m: int, near_zero: float):
    stream = Keystream.seeded("f16")
    points = stream.normal((40, 512))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    templates = lift(points, strategy="random", m=m, stream=stream)
    read = SubspaceBatch.of([decode(encode(t, contract_id=CONTRACT)).subspace for t in templates])
    for metric in Metric:
        before = pairwise_distances(points, templates, metric=metric)
        after = pairwise_distances(points, read, metric=metric)
        own = np.eye(40, dtype=bool)
        assert 1e-5 < after[own].max() < near_zero  # as docs/formats.md says
        assert 1e-6 < np.abs(after - before)[~own].max() < 1e-4


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_library_reads_what_we_write_and_we_what_it_writes(dtype: WireDtype):
    original = template()
    ours = encode(original, contract_id=CONTRACT, dtype=dtype)
    assert ours == encode(template(), contract_id=CONTRACT, dtype=dtype)
    tensors = safetensors.numpy.load(ours)
    np.testing.assert_array_equal(tensors["basis"], original.basis.astype(dtype))
    np.testing.assert_array_equal(tensors["foot"], original.foot.astype(dtype))
    metadata = {"format": "veilface-template", "version": "1", "contract_id": CONTRACT}
    theirs = safetensors.numpy.save(tensors, metadata=metadata)
    assert parts(theirs)[0]["basis"]["data_offsets"][0] == 0  # the library puts the basis first
    np.testing.assert_array_equal(decode(theirs).subspace.basis, decode(ours).subspace.basis)
    np.testing.assert_array_equal(decode(theirs).subspace.foot, decode(ours).subspace.foot)


def test_documented_sizes_are_true():
    text = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (\d+) \| ([\d,]+) \| ([\d,]+) \|$", text, re.MULTILINE)
    assert len(rows) >= 4
    for n, m, half, single in rows:
        assert encoded_size(int(n), int(m), "float16") == int(half.replace(",", ""))
        assert encoded_size(int(n), int(m), "float32") == int(single.replace(",", ""))
    example = re.search(r"```json\n(.*?)```", text, re.DOTALL)
    assert example is not None
    documented = json.loads(example.group(1).replace("<64 lower-case hex digits>", CONTRACT))
    assert documented == parts(encode(template(228, 120), contract_id=CONTRACT))[0]


def test_what_cannot_be_written_is_refused():
    good = template()
    with pytest.raises(InvalidTemplate, match="contract id"):
        encode(good, contract_id=CONTRACT.upper())
    with pytest.raises(InvalidTemplate, match="not orthonormal"):
        encode(SubspaceBatch(good.foot, good.basis * 1.1), contract_id=CONTRACT)


# --- hostile input -----------------------------------------------------------------------------


def changed(path: tuple[str, ...], value: object) -> bytes:
    """A template whose header has another value at ``path``."""
    header, payload = parts(encode(template(), contract_id=CONTRACT))
    target = header
    for name in path[:-1]:
        target = target[name]
    if value is None:
        del target[path[-1]]
    else:
        target[path[-1]] = value
    return packed(header, payload)


HEADERS = {
    "other format": (("__metadata__", "format"), "pt"),
    "other version": (("__metadata__", "version"), "2"),
    "no contract": (("__metadata__", "contract_id"), None),
    "contract with a newline": (("__metadata__", "contract_id"), CONTRACT + "\n"),
    "extra metadata": (("__metadata__", "note"), "x"),
    "no metadata": (("__metadata__",), None),
    "no foot": (("foot",), None),
    "extra tensor": (("more",), {"dtype": "F16", "shape": [0], "data_offsets": [0, 0]}),
    "integers": (("foot", "dtype"), "I16"),
    "unequal dtypes": (("foot", "dtype"), "F32"),
    "unequal n": (("foot", "shape"), [25]),
    "huge n": (("basis", "shape"), [5, 2**40]),
    "negative": (("basis", "shape"), [-5, -24]),
    "zero m": (("basis", "shape"), [0, 24]),
    "boolean": (("basis", "shape"), [True, 24]),
    "float": (("basis", "shape"), [5.0, 24]),
    "shape as a string": (("basis", "shape"), "ab"),
    "overlap": (("basis", "data_offsets"), [0, 240]),
    "beyond the end": (("basis", "data_offsets"), [48, 10**9]),
}


@pytest.mark.parametrize("name", HEADERS)
def test_each_wrong_header_is_refused(name: str):
    path, value = HEADERS[name]
    with pytest.raises(InvalidTemplate, match=r"^template refused: "):
        decode(changed(path, value))


def test_malformed_containers_are_refused():
    good = encode(template(), contract_id=CONTRACT)
    header, payload = parts(good)
    text = json.dumps(header).encode()
    twice = text.replace(b'{"dtype"', b'{"dtype": "F16", "dtype"', 1)
    both_feet = text[:-1] + b', "foot": ' + json.dumps(header["foot"]).encode() + b"}"
    deep = b'{"a":' + b"[" * 4000  # deeper than the parser recurses
    for data, reason in (
        (b"", "no header"),
        (good[:7], "no header"),
        (struct.pack("<Q", 2**63) + good[8:], "no header"),
        (struct.pack("<Q", MAX_HEADER_BYTES + 1) + bytes(MAX_HEADER_BYTES + 1), "no header"),
        (struct.pack("<Q", 4000) + good[8:300], "truncated"),
        (packed(twice, payload), "duplicate key"),
        (packed(both_feet, payload), "duplicate key"),
        (packed(b"[]", payload), "not a JSON object"),
        (packed(b" " + text, payload), "not a JSON object"),
        (packed(b"{", payload), "not valid JSON"),
        (packed(b"{\xff\xfe}", payload), "not valid JSON"),
        (packed(deep, payload), "not valid JSON"),
        (packed(b'{"a": ' + b"9" * 4080 + b"}", payload), "not the members"),
        (packed(b'{"a": NaN}', payload), "not finite"),
        (packed(text, payload[:-1]), "do not fill the payload"),
        (packed(text, payload + b"\0"), "do not fill the payload"),
        (good + b"\0" * 8, "do not fill the payload"),
    ):
        with pytest.raises(InvalidTemplate, match=reason):
            decode(data)


def test_size_is_refused_before_anything_is_read():
    with pytest.raises(InvalidTemplate, match="more than"):
        decode(bytes(MAX_BYTES + 1))
    for n, m in ((4097, 2), (400, 193), (9, 9)):
        with pytest.raises(InvalidTemplate, match="out of range"):
            decode(changed(("basis", "shape"), [m, n]))


@pytest.mark.parametrize("dtype", DTYPES)
def test_wrong_numbers_are_refused(dtype: WireDtype):
    good = template()
    header, _ = parts(encode(good, contract_id=CONTRACT, dtype=dtype))

    def with_numbers(foot: np.ndarray, basis: np.ndarray) -> bytes:
        return packed(header, foot.astype(dtype).tobytes() + basis.astype(dtype).tobytes())

    decode(with_numbers(good.foot, good.basis))
    nan, infinite, zero = good.basis.copy(), good.basis.copy(), good.basis.copy()
    nan[2, 3], infinite[0, 0], zero[1] = np.nan, -np.inf, 0
    largest = np.full_like(good.foot, 6e4 if dtype == "float16" else 3e38)
    for foot, basis, reason in (
        (good.foot, nan, "not finite"),
        (good.foot, infinite, "not finite"),
        (good.foot * np.nan, good.basis, "not finite"),
        (largest, good.basis, "not orthogonal"),
        (good.foot, good.basis * 1.01, "not orthonormal"),
        (good.foot, zero, "not orthonormal"),
        (good.foot, good.basis[[0, 0, 1, 2, 3]], "not orthonormal"),
        (good.foot + 0.01 * good.basis[0], good.basis, "not orthogonal"),
        (good.foot * (1.01 / good.foot_norm), good.basis, "outside the unit ball"),
    ):
        with pytest.raises(InvalidTemplate, match=reason):
            decode(with_numbers(foot, basis))


@pytest.mark.parametrize(
    ("dtype", "number"), [("float16", b"\x01\x7c"), ("float32", b"\x01\x00\x80\x7f")]
)
def test_a_signalling_nan_is_refused_and_not_warned_of(dtype: WireDtype, number: bytes):
    data = encode(template(), contract_id=CONTRACT, dtype=dtype)
    start = len(data) - len(parts(data)[1])
    for at in (start, len(data) - len(number)):
        broken = data[:at] + number + data[at + len(number) :]
        with pytest.raises(InvalidTemplate, match="not finite"):
            decode(broken)
