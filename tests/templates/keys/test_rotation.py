import hashlib
import hmac

import numpy as np
import pytest
import scipy.linalg
from scipy import stats

from templates.distances import Metric, pairwise_distances
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION, rotate, tenant_rotation
from templates.space.lifting import lift


def units(stream: Keystream, count: int, n: int) -> np.ndarray:
    rows = stream.normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_matrix_follows_from_the_key_as_documented():
    key, n = b"k" * 32, 24
    # HKDF (RFC 5869) by hand: extract with a zero salt, expand one block.
    extracted = hmac.new(bytes(32), key, hashlib.sha256).digest()
    info = f"veilface tenant rotation {ROTATION_VERSION} n={n}".encode()
    derived = hmac.new(extracted, info + b"\x01", hashlib.sha256).digest()
    words = np.frombuffer(Keystream(derived).token(8 * n * n), dtype=np.uint64)
    gaussian = stats.norm.ppf(words / 2.0**64).reshape(n, n)
    q, r = scipy.linalg.qr(gaussian)
    expected = q * np.sign(np.diag(r))
    np.testing.assert_allclose(tenant_rotation(key, n), expected, atol=1e-9)


def test_matrix_is_orthogonal_and_belongs_to_key_and_dimension():
    a = tenant_rotation(b"a" * 32, 64)
    np.testing.assert_allclose(a @ a.T, np.eye(64), atol=1e-13)
    np.testing.assert_array_equal(a, tenant_rotation(b"a" * 32, 64))
    assert np.abs(a - tenant_rotation(b"b" * 32, 64)).max() > 0.1
    assert np.abs(a[:32, :32] - tenant_rotation(b"a" * 32, 32)).max() > 0.1


def test_matrices_are_distributed_by_the_haar_measure():
    n = 6
    matrices = np.stack([tenant_rotation(i.to_bytes(32), n) for i in range(1500)])
    # The square of any entry is Beta(1/2, (n - 1)/2); without the sign fix the diagonal is not.
    for row, column in ((0, 0), (5, 5), (2, 4)):
        entries = matrices[:, row, column]
        assert stats.kstest(entries**2, "beta", (0.5, (n - 1) / 2)).pvalue > 1e-3
        assert stats.binomtest(int((entries > 0).sum()), 1500).pvalue > 1e-3
    assert stats.binomtest(int((np.linalg.det(matrices) > 0).sum()), 1500).pvalue > 1e-3


@pytest.mark.parametrize("metric", list(Metric))
def test_distances_inside_a_tenant_do_not_change(metric: Metric):
    stream = Keystream.seeded("tenant")
    points, others = units(stream, 9, 40), units(stream, 7, 40)
    a = lift(points, strategy="random", m=12, stream=stream)
    b = lift(others, strategy="random", m=7, stream=stream)
    rotation = tenant_rotation(b"r" * 32, 40)
    for probes, moved in ((points, rotate(points, rotation)), (a, a.rotated(rotation))):
        before = pairwise_distances(probes, b, metric=metric, dtype=np.float64)
        after = pairwise_distances(moved, b.rotated(rotation), metric=metric, dtype=np.float64)
        np.testing.assert_allclose(after, before, atol=1e-6)


def test_rotating_before_lifting_is_rotating_after():
    stream = Keystream.seeded("order")
    points = units(stream, 5, 30)
    rotation = tenant_rotation(b"r" * 32, 30)
    templates = lift(points, strategy="random", m=4, stream=stream).rotated(rotation)
    for template, point in zip(templates, rotate(points, rotation), strict=True):
        template.validate(1e-6)
        assert template.contains(point)
    back = templates.rotated(rotation.T)
    assert all(t.contains(p) for t, p in zip(back, points, strict=True))


def test_key_and_dimension_are_checked():
    with pytest.raises(ValueError, match="32 bytes, not 31"):
        tenant_rotation(bytes(31), 8)
    with pytest.raises(ValueError, match="dimension"):
        tenant_rotation(bytes(32), 0)
