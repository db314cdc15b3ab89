import tracemalloc

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from templates.errors import InvalidTemplate, LiftingError
from templates.keys.randomness import Keystream
from templates.space import subspace
from templates.space.subspace import SubspaceBatch


def units(stream: Keystream, count: int, n: int) -> np.ndarray:
    rows = stream.normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def through_all(members: np.ndarray, first: int, *, stream: Keystream) -> SubspaceBatch:
    """The set that holds all members, described from one of them."""
    others = np.delete(members, first, axis=0)
    return SubspaceBatch.through(members[first], others - members[first], stream=stream)


@given(n=st.integers(2, 40), m_part=st.floats(0, 1), seed=st.integers(0, 10**6))
def test_template_holds_the_set_and_is_canonical(n: int, m_part: float, seed: int):
    m = 1 + int(m_part * (n - 2))
    stream = Keystream.seeded(seed)
    members = units(stream, m + 1, n)
    template = through_all(members, 0, stream=stream)
    template.validate(1e-6)
    assert (template.n, template.m) == (n, m)
    assert template.contains(members, tol=1e-4).all()
    # The foot point is the minimum-norm solution of "lies in the set", found independently.
    normals = scipy.linalg.null_space(members[1:] - members[0]).T
    nearest = np.linalg.lstsq(normals, normals @ members[0], rcond=None)[0]
    np.testing.assert_allclose(template.foot, nearest, atol=1e-4)


def test_equal_sets_give_equal_templates_whatever_describes_them():
    members = units(Keystream.seeded("members"), 9, 64)
    mixing = Keystream.seeded("mixing").normal((8, 8))
    first = through_all(members, 0, stream=Keystream.seeded("lift"))
    for other in range(1, 9):
        again = through_all(members, other, stream=Keystream.seeded("lift"))
        np.testing.assert_allclose(again.foot, first.foot, atol=1e-6)
        np.testing.assert_allclose(again.basis, first.basis, atol=1e-6)
    point = members.mean(axis=0)
    mixed = SubspaceBatch.through(
        point, mixing @ (members[1:] - members[0]), stream=Keystream.seeded("lift")
    )
    np.testing.assert_allclose(mixed.basis, first.basis, atol=1e-6)


def test_templates_of_one_set_are_identically_distributed():
    """Nothing tells which member of the set was lifted; a basis that does is noticed."""
    count, n = 3000, 16
    members = units(Keystream.seeded("people"), 4, n)
    probes = [members[0] - members[1], members[2] - members[0], members[3] - members[1]]

    def lifted(first: int) -> np.ndarray:
        directions = np.delete(members, first, axis=0) - members[first]
        return SubspaceBatch.through(
            np.tile(members[first], (count, 1)),
            np.tile(directions, (count, 1, 1)),
            stream=Keystream.seeded("distribution", first),
        ).bases

    def signed(first: int) -> np.ndarray:
        """A random linear mix of the directions themselves: it points away from the member."""
        directions = np.delete(members, first, axis=0) - members[first]
        mix = Keystream.seeded("leak", first).uniform((count, 3, 3))
        return mix @ directions

    def smallest_pvalue(one: np.ndarray, two: np.ndarray) -> float:
        return min(
            stats.ks_2samp(one[:, row] @ probe, two[:, row] @ probe).pvalue
            for row in range(3)
            for probe in probes
        )

    assert smallest_pvalue(lifted(0), lifted(1)) > 1e-3
    assert smallest_pvalue(signed(0), signed(1)) < 1e-9


def test_basis_is_haar_distributed_in_the_span():
    count, n, m = 4000, 12, 3
    members = units(Keystream.seeded("haar"), m + 1, n)
    directions = members[1:] - members[0]
    bases = SubspaceBatch.through(
        np.tile(members[0], (count, 1)),
        np.tile(directions, (count, 1, 1)),
        stream=Keystream.seeded("haar", 1),
    ).bases
    axis = scipy.linalg.orth(directions.T)[:, 0]
    for row in range(m):
        cosines = bases[:, row] @ axis
        assert stats.kstest(cosines**2, "beta", (0.5, (m - 1) / 2)).pvalue > 1e-3
        assert stats.binomtest(int((cosines > 0).sum()), count).pvalue > 1e-3


def test_batch_does_not_depend_on_the_tile(monkeypatch: pytest.MonkeyPatch):
    points = units(Keystream.seeded("p"), 20, 30)
    directions = Keystream.seeded("d").normal((20, 5, 30))
    whole = SubspaceBatch.through(points, directions, stream=Keystream.seeded(1))
    monkeypatch.setattr(subspace, "_TILE_BYTES", 3 * 8 * 5 * 30)
    tiled = SubspaceBatch.through(points, directions, stream=Keystream.seeded(1))
    np.testing.assert_allclose(tiled.feet, whole.feet, atol=1e-6)
    for one, other in zip(tiled, whole, strict=True):
        np.testing.assert_allclose(one.project(points), other.project(points), atol=1e-5)


def test_memory_is_bounded_by_the_tile(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(subspace, "_TILE_BYTES", 1 << 20)
    points = units(Keystream.seeded("p"), 2000, 128).astype(np.float32)
    directions = Keystream.seeded("d").normal((2000, 8, 128)).astype(np.float32)
    result = 4 * 2000 * 128 * 9
    tracemalloc.start()
    SubspaceBatch.through(points, directions, stream=Keystream.seeded(1))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert result < peak < result + (8 << 20)


def test_degenerate_requests_are_refused():
    stream = Keystream.seeded("bad")
    point, directions = units(stream, 1, 8)[0], stream.normal((3, 8))
    dependent, zero, infinite = directions.copy(), directions.copy(), directions.copy()
    dependent[2] = dependent[0] - 2 * dependent[1]
    zero[1] = 0
    infinite[1, 3] = np.inf
    for bad, reason in (
        (dependent, "linearly dependent"),
        (zero, "length zero"),
        (infinite, "not finite"),
        (stream.normal((8, 8)), "1 <= m < n"),
        (stream.normal((0, 8)), "1 <= m < n"),
        (stream.normal((3, 9)), "do not fit"),
        (directions[None, None], "do not fit"),
    ):
        with pytest.raises(LiftingError, match=reason):
            SubspaceBatch.through(point, bad, stream=stream)


def test_shapes_are_checked_by_the_constructors():
    for foot, basis in (
        (np.zeros(4), np.zeros((2, 5))),
        (np.zeros(4), np.zeros((4, 4))),
        (np.zeros(4), np.zeros((0, 4))),
        (np.zeros((1, 4)), np.zeros((2, 4))),
    ):
        with pytest.raises(InvalidTemplate):
            SubspaceBatch(foot, basis)
        with pytest.raises(InvalidTemplate):
            SubspaceBatch(foot[None], basis[None])
    with pytest.raises(InvalidTemplate, match="at least one"):
        SubspaceBatch.of([])
    one, other = (SubspaceBatch(np.zeros(4), np.eye(m, 4)) for m in (1, 2))
    with pytest.raises(InvalidTemplate, match="different dimensions"):
        SubspaceBatch.of([one, other])


def test_batch_indexes_like_a_list_of_templates():
    stream = Keystream.seeded("batch")
    batch = SubspaceBatch.through(units(stream, 5, 9), stream.normal((5, 2, 9)), stream=stream)
    assert len(batch) == len(list(batch)) == 5
    np.testing.assert_array_equal(batch[3].basis, batch.bases[3])
    np.testing.assert_array_equal(batch[1:3].feet, batch.feet[1:3])
    np.testing.assert_array_equal(batch[np.array([4, 0])].bases, batch.bases[[4, 0]])
    np.testing.assert_array_equal(SubspaceBatch.of(list(batch)).bases, batch.bases)
    np.testing.assert_allclose(batch.foot_norms, [t.foot_norm for t in batch])
    with pytest.raises(ValueError, match="too many values"):
        _ = batch.foot
    assert not batch.bases.flags.writeable
    assert repr(batch) == "SubspaceBatch(5 of n=9, m=2)"
