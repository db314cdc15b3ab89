"""Embeddings that were computed before: in memory, or in a file that only a sealer opens.

An embedding is as sensitive as the face it came from, so there is no way to write one in the
clear.
"""

import contextlib
import os
import struct
import tempfile
import threading
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models.errors import CacheError

CONTEXT = "veilface/embedding-cache/1"
_MAGIC = b"VFEC1\0"
_HEADER = struct.Struct("<6sII")  # magic, numbers per embedding, entries
_KEY_BYTES = 32


class CacheSealer(Protocol):
    """Authenticated encryption, supplied by the caller."""

    def seal(self, plaintext: bytes, *, context: str) -> bytes:
        """Encrypt, bound to ``context``."""
        ...

    def open(self, sealed: bytes, *, context: str) -> bytes:
        """Decrypt what `seal` made with the same ``context``; raise on anything else."""
        ...


class EmbeddingCache:
    """Embeddings by a 32-byte key; safe from several threads.

    Use it bare to keep them in memory, or `open_file` to keep them between runs.
    """

    def __init__(self) -> None:
        self._entries: dict[bytes, NDArray[np.float32]] = {}
        self._path: Path | None = None
        self._sealer: CacheSealer | None = None
        self._changed = False
        self._lock = threading.Lock()

    @classmethod
    def open_file(cls, path: str | Path, sealer: CacheSealer) -> "EmbeddingCache":
        """Open an encrypted cache file, or start one where there is none.

        Raises
        ------
        CacheError
            If the opened content is no embedding cache. What the sealer raises for a wrong key or
            a changed file passes through.
        """
        cache = cls()
        cache._path, cache._sealer = Path(path), sealer
        if cache._path.exists():
            cache._entries = _decode(sealer.open(cache._path.read_bytes(), context=CONTEXT))
        return cache

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        return f"EmbeddingCache({len(self)} entries)"

    def get(self, key: bytes) -> NDArray[np.float32] | None:
        """Embedding of ``key``, float32, shape (n,), or ``None``."""
        with self._lock:
            return self._entries.get(key)

    def put(self, key: bytes, embedding: NDArray[np.float32]) -> None:
        """Keep an embedding; on disk only after `flush`."""
        with self._lock:
            self._entries[key] = np.array(embedding, dtype=np.float32)
            self._changed = True

    def flush(self) -> None:
        """Write the file anew if anything changed; the old one stays until the new one is whole."""
        with self._lock:
            if self._path is None or self._sealer is None or not self._changed:
                return
            sealed = self._sealer.seal(_encode(self._entries), context=CONTEXT)
            _replace(self._path, sealed)
            self._changed = False


def _encode(entries: dict[bytes, NDArray[np.float32]]) -> bytes:
    """Group by dimension, so that packs of different n can share a file."""
    blocks = []
    for n in sorted({len(embedding) for embedding in entries.values()}):
        chosen = {key: value for key, value in entries.items() if len(value) == n}
        blocks.append(_HEADER.pack(_MAGIC, n, len(chosen)))
        blocks.extend(key + value.astype("<f4").tobytes() for key, value in chosen.items())
    return b"".join(blocks)


def _decode(content: bytes) -> dict[bytes, NDArray[np.float32]]:
    entries: dict[bytes, NDArray[np.float32]] = {}
    position = 0
    while position < len(content):
        if len(content) - position < _HEADER.size:
            raise CacheError("The embedding cache ends inside a header; delete the file.")
        magic, n, count = _HEADER.unpack_from(content, position)
        position += _HEADER.size
        size = _KEY_BYTES + 4 * n
        if magic != _MAGIC or count * size > len(content) - position:
            raise CacheError("The file is not an embedding cache of this version; delete it.")
        for _ in range(count):
            key = content[position : position + _KEY_BYTES]
            values = np.frombuffer(content, dtype="<f4", count=n, offset=position + _KEY_BYTES)
            entries[key] = values.astype(np.float32)
            position += size
    return entries


def _replace(path: Path, content: bytes) -> None:
    """Write atomically with mode 0600; the temporary file holds sealed bytes only."""
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(name).replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            Path(name).unlink()
        raise
