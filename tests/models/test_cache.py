import io
import os
import stat

import numpy as np
import pytest

from models.cache import CONTEXT, EmbeddingCache
from models.errors import CacheError


class Xor:
    """A reversible stand-in that is no encryption, but changes every byte and checks a tag."""

    def seal(self, plaintext, *, context):
        return context.encode() + b"|" + bytes(b ^ 0xA5 for b in plaintext)

    def open(self, sealed, *, context):
        head = context.encode() + b"|"
        if not sealed.startswith(head):
            raise ValueError("wrong context")
        return bytes(b ^ 0xA5 for b in sealed[len(head) :])


def vector(seed: int, n: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=n).astype(np.float32)


def test_file_round_trip_with_packs_of_different_size(tmp_path):
    path = tmp_path / "embeddings.cache"
    cache = EmbeddingCache(path, Xor())
    for seed in range(5):
        cache.put(bytes([seed]) * 32, vector(seed, 8 if seed % 2 else 16))
    cache.flush()
    again = EmbeddingCache(path, Xor())
    assert len(again) == 5
    for seed in range(5):
        np.testing.assert_array_equal(
            again.get(bytes([seed]) * 32), vector(seed, 8 if seed % 2 else 16)
        )
    assert again.get(b"z" * 32) is None


def test_no_embedding_lies_on_disk_in_the_clear(tmp_path):
    path = tmp_path / "embeddings.cache"
    cache = EmbeddingCache(path, Xor())
    cache.put(b"k" * 32, vector(3))
    cache.flush()
    assert [file.name for file in tmp_path.iterdir()] == ["embeddings.cache"]
    content = path.read_bytes()
    assert vector(3).tobytes() not in content
    assert vector(3).tobytes()[:4] not in content
    assert vector(3).tobytes() in Xor().open(content, context=CONTEXT)  # the search can find it
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_failed_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path, monkeypatch):
    path = tmp_path / "embeddings.cache"
    cache = EmbeddingCache(path, Xor())
    cache.put(b"a" * 32, vector(1))
    cache.flush()
    before = path.read_bytes()
    cache.put(b"b" * 32, vector(2))

    def full(_descriptor):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="disk full"):
        cache.flush()
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def npz(**arrays: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


KEYS = np.zeros((2, 32), np.uint8)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"VFEC1",
        npz(keys_8=KEYS, embeddings_8=np.zeros((2, 8), np.float32))[:-30],
        npz(keys_8=KEYS),
        npz(keys_8=KEYS, embeddings_8=np.zeros((3, 8), np.float32)),
        npz(keys_8=KEYS, embeddings_8=np.zeros((2, 8), np.float64)),
        npz(keys_8=np.array([{}]), embeddings_8=np.zeros((1, 8), np.float32)),
    ],
)
def test_opened_content_is_checked(tmp_path, content):
    path = tmp_path / "embeddings.cache"
    path.write_bytes(Xor().seal(content, context=CONTEXT))
    with pytest.raises(CacheError, match="delete it"):
        EmbeddingCache(path, Xor())
