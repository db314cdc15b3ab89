import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from templates.keys.randomness import KEY_BYTES, Keystream

# RFC 8439, appendix A.1, test vector 1: key, nonce and counter zero.
RFC_8439_A1 = bytes.fromhex(
    "76b8e0ada0f13d90405d6ae55386bd28bdd219b8a08ded1aa836efcc8b770dc7"
    "da41597c5157488d7724e03fb8d84a376a43b8f41518a11cc387b669b2ee6586"
)


class Fixed(Keystream):
    """A stream whose words are given."""

    def __init__(self, *words: int) -> None:
        super().__init__(bytes(KEY_BYTES))
        self.rest = list(words)

    def token(self, nbytes: int) -> bytes:
        words, self.rest = self.rest[: nbytes // 8], self.rest[nbytes // 8 :]
        return np.array(words, dtype=np.uint64).tobytes()


def test_stream_is_chacha20():
    stream = Keystream(bytes(KEY_BYTES))
    assert stream.token(30) + stream.token(34) == RFC_8439_A1


def test_uniforms_are_made_of_the_words_of_the_stream_in_order():
    count = 200_000  # more than one tile
    words = np.frombuffer(Keystream.seeded("w").token(8 * count), dtype=np.uint64)
    uniform = Keystream.seeded("w").uniform((2, count // 2), -3.0, 5.0)
    np.testing.assert_allclose(uniform.ravel(), -3 + 8 * (words / 2.0**64), atol=1e-14)


def test_normals_are_normal_and_independent():
    normal = Keystream.seeded("w").normal((2, 100_001))  # more than one tile, and odd
    assert stats.kstest(normal.ravel(), "norm").pvalue > 1e-3
    assert stats.kstest(normal[0] ** 2 + normal[1] ** 2, stats.expon(scale=2).cdf).pvalue > 1e-3
    assert abs(np.mean(normal[:, 1:] * normal[:, :-1])) < 0.01
    # Two samples of one tile share a radius: neither they nor their squares are correlated.
    one, other = normal.ravel()[: 1 << 15], normal.ravel()[1 << 15 : 1 << 16]
    for power in (1, 2):
        assert abs(np.corrcoef(one**power, other**power)[0, 1]) < 0.03


@pytest.mark.parametrize("word", [0, 2**64 - 1])
def test_extreme_words_give_finite_normals_and_uniforms_in_range(word: int):
    assert np.abs(Fixed(word, word).normal(2)).max() < 9
    assert 0 <= Fixed(word).uniform(1)[0] < 1


def test_seed_parts_are_encoded_without_ambiguity():
    seeds = [("ab",), ("a", "b"), ("a", "b", ""), (1,), ("1",), (1, 1), (11,), ('a","b',)]
    assert len({Keystream.seeded(*parts).token(16) for parts in seeds}) == len(seeds)
    assert Keystream.seeded("a", 1).token(16) == Keystream.seeded("a", 1).token(16)
    with pytest.raises(ValueError, match="at least one part"):
        Keystream.seeded()


def test_fresh_streams_differ():
    assert Keystream.fresh().token(32) != Keystream.fresh().token(32)
    with pytest.raises(ValueError, match="32 bytes, not 16"):
        Keystream(bytes(16))


@given(
    population=st.integers(0, 200),
    rows=st.integers(0, 20),
    part=st.floats(0, 1),
    seed=st.integers(0, 10**6),
)
def test_choose_gives_different_integers_in_range(population, rows, part, seed):
    k = int(part * population)
    chosen = Keystream.seeded(seed).choose(population, rows, k)
    assert chosen.shape == (rows, k)
    assert chosen.dtype == np.int64
    assert ((chosen >= 0) & (chosen < population)).all()
    assert all(len(set(row)) == k for row in chosen.tolist())


def test_every_ordered_choice_is_equally_likely():
    chosen = Keystream.seeded("choice").choose(5, 60_000, 3)
    counts = np.unique(chosen @ [25, 5, 1], return_counts=True)[1]
    assert len(counts) == 5 * 4 * 3
    assert stats.chisquare(counts).pvalue > 1e-3


def test_integers_reject_the_incomplete_last_run():
    # 2**64 mod 3 is 1: the largest word would make 0 more likely.
    assert Fixed(2**64 - 1, 2**64 - 2, 5).integers(3, 2).tolist() == [2, 2]
    # 2**64 is divisible by 4: no word is rejected.
    assert Fixed(2**64 - 1).integers(4, 1).tolist() == [3]


def test_a_stream_is_not_copied_or_shown():
    key = bytes(range(KEY_BYTES))
    stream = Keystream(key)
    for leak in (copy.copy, copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="repeat each other"):
            leak(stream)
    assert repr(stream) == "Keystream()"
