import hashlib
import hmac
import itertools
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from templates.distances import Metric, pairwise_distances
from templates.keys.randomness import Keystream
from templates.keys.rotation import (
    TRANSFORMS,
    Rotation,
    TenantRotation,
    holder_rotation,
)
from templates.keys.sealing import encode_parts
from templates.space.lifting import lift


def units(stream: Keystream, count: int, n: int) -> np.ndarray:
    rows = stream.normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def expanded(key: bytes, info: bytes, length: int) -> bytes:
    """HKDF-SHA-256 (RFC 5869) by hand, with a zero salt."""
    extracted = hmac.new(bytes(32), key, hashlib.sha256).digest()
    out, block = b"", b""
    for number in range(1, -(-length // 32) + 1):
        block = hmac.new(extracted, block + info + bytes([number]), hashlib.sha256).digest()
        out += block
    return out[:length]


def matrix(rotation: Rotation, n: int) -> NDArray[np.float64]:
    return rotation.turned(np.eye(n)).T


def rotations(count: int, n: int) -> Callable[[str], Rotation]:
    """The rotation of a template id, under the first of `count` keys."""
    return TenantRotation(count.to_bytes(32), n).of


@pytest.mark.parametrize("whose", ["template", "holder"])
@pytest.mark.parametrize("n", [1, 2, 3, 24, 31, 64])
def test_a_rotation_follows_from_key_and_id_or_salt_as_documented(n: int, whose: str) -> None:
    key, salt = bytes(range(32)), "0123456789abcdef" * 2
    count = (TRANSFORMS + 1) * n
    info = encode_parts(f"{whose} rotation", "signs-hartley-1", n, salt)
    if whose == "template":
        made = TenantRotation(key, n).of(salt)
    else:
        made = holder_rotation(bytearray(key), salt, n)
    derived = expanded(key, info, -(-count // 8))
    bits = [byte >> (7 - place) & 1 for byte in derived for place in range(8)][:count]
    signs = np.where(np.reshape(bits, (-1, n)), -1.0, 1.0)
    # The orthonormal Hartley transform from its definition.
    angles = 2 * np.pi * np.outer(np.arange(n), np.arange(n)) / n
    hartley = (np.cos(angles) + np.sin(angles)) / np.sqrt(n)
    expected = np.diag(signs[0])
    for each in signs[1:]:
        expected = np.diag(each) @ hartley @ expected
    np.testing.assert_allclose(matrix(made, n), expected, atol=1e-12)


@pytest.mark.parametrize("n", [2, 7, 64, 127, 512])
def test_rotations_are_orthogonal_and_undone(n: int) -> None:
    rotation = TenantRotation(b"a" * 32, n).of("template")
    found = matrix(rotation, n)
    np.testing.assert_allclose(found @ found.T, np.eye(n), atol=1e-12)
    np.testing.assert_allclose(rotation.turned_back(np.eye(n)), found, atol=1e-12)
    points = units(Keystream.seeded("points"), 3, n)
    kept = points.copy()
    np.testing.assert_allclose(rotation.turned(points), points @ found.T, atol=1e-12)
    np.testing.assert_array_equal(points, kept)
    np.testing.assert_allclose(rotation.turned_back(rotation.turned(points)), points, atol=1e-12)


def test_another_key_id_salt_or_holder_gives_an_unrelated_rotation() -> None:
    """tr(AᵀB) of independent rotations has mean 0 and variance near 1, whatever n."""
    n, key = 128, b"a" * 32
    made = [
        TenantRotation(key, n).of("template"),
        TenantRotation(key, n).of("template2"),
        TenantRotation(b"b" * 32, n).of("template"),
        TenantRotation(b"a" * 31 + b"b", n).of("template"),
        holder_rotation(key, "template", n),
        holder_rotation(key, "template2", n),
        holder_rotation(b"b" * 32, "template", n),
    ]
    for one, other in itertools.combinations([matrix(rotation, n) for rotation in made], 2):
        assert abs(np.vdot(one, other)) < 8
    wide = TenantRotation(key, 2 * n).of("template")
    assert (wide.signs[0, :n] != made[0].signs[0]).any()


@pytest.mark.parametrize("n", [64, 97, 512])
def test_entries_are_those_of_a_haar_rotation(n: int) -> None:
    """R x of fixed x, over many keys: entries are near N(0, 1/n), the worst x included.

    Bounds are six standard errors of what a Haar rotation gives. A single transform between signs
    fails them: the control at the end.
    """
    keys = 2000
    stream = Keystream.seeded("entries")
    axis = np.zeros(n)
    axis[1] = 1.0
    fixed = np.stack([axis, np.full(n, n**-0.5), *units(stream, 2, n)])
    seen = np.stack([rotations(7, n)(str(number)).turned(fixed) for number in range(keys)])
    moments = seen.transpose(1, 0, 2) * np.sqrt(n)  # (4, keys, n)
    assert np.abs(moments.mean(axis=1)).max() < 6 / np.sqrt(keys)
    assert np.abs((moments**2).mean(axis=1) - 1).max() < 6 * np.sqrt(2 / keys) + 2 / n
    # Kurtosis over all entries: 3 n / (n + 2) of a uniform point of the sphere.
    fourth = (moments**4).mean(axis=(1, 2))
    assert np.abs(fourth - 3 * n / (n + 2)).max() < 6 * np.sqrt(96 / (keys * n)) + 3 / n
    for rows in moments:
        assert stats.kstest(rows[:, 3], "norm").pvalue > 1e-7
    # Different entries are not correlated, be they of one point or of two.
    for one, other in ((2, 2), (0, 2), (0, 0)):
        products = moments[one][:, :-1] * moments[other][:, 1:]
        assert abs(products.mean()) < 6 / np.sqrt(products.size)
    single = np.stack([Rotation(signs).turned(fixed[:1])[0] for signs in _signs(keys, 2, n)])
    assert np.abs((single**2 * n).mean(axis=0) - 1).max() > 0.9


def _signs(count: int, rows: int, n: int) -> NDArray[np.float64]:
    return np.where(Keystream.seeded("signs").uniform((count, rows, n)) < 0.5, -1.0, 1.0)


@pytest.mark.parametrize("metric", list(Metric))
def test_a_probe_that_is_turned_as_the_template_is_as_far_from_it(metric: Metric) -> None:
    stream = Keystream.seeded("tenant")
    points, others = units(stream, 9, 40), units(stream, 7, 40)
    a = lift(points, strategy="random", m=12, stream=stream)
    b = lift(others, strategy="random", m=7, stream=stream)
    turned = TenantRotation(b"r" * 32, 40).of("template").turned
    for probes, moved in ((points, turned(points)), (a, a.turned_by(turned))):
        before = pairwise_distances(probes, b, metric=metric)
        after = pairwise_distances(moved, b.turned_by(turned), metric=metric)
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_turning_before_lifting_is_turning_after() -> None:
    stream = Keystream.seeded("order")
    points = units(stream, 5, 30)
    rotation = TenantRotation(b"r" * 32, 30).of("template")
    templates = lift(points, strategy="random", m=4, stream=stream).turned_by(rotation.turned)
    for template, point in zip(templates, rotation.turned(points), strict=True):
        template.validate(1e-6)
        assert template.contains(point)
    back = templates.turned_by(rotation.turned_back)
    assert all(t.contains(p) for t, p in zip(back, points, strict=True))


def test_key_and_dimension_are_checked_and_the_key_is_not_shown() -> None:
    for length in (0, 31, 33):
        with pytest.raises(ValueError, match=f"32 bytes, not {length}"):
            TenantRotation(bytes(length), 8)
        with pytest.raises(ValueError, match=f"32 bytes, not {length}"):
            holder_rotation(bytes(length), "salt", 8)
    with pytest.raises(ValueError, match="dimension"):
        TenantRotation(bytes(32), 0)
    tenant = TenantRotation(b"secret" * 5 + b"xy", 8)
    assert repr(tenant) == "TenantRotation(n=8)"
