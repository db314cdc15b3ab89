"""Embeddings that were computed before: in memory, or in a file that only a sealer opens.

An embedding is as sensitive as the face it came from, so there is no way to write one in the
clear.
"""

import io
import os
import tempfile
import threading
import zipfile
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from models.errors import CacheError

CONTEXT = "veilface/embedding-cache/2"


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

    They are kept in memory, and with a path in a file too: a sealed npz with an array of keys,
    uint8 (k, 32), and one of embeddings, float32 (k, n), for each n.
    """

    def __init__(self, path: str | Path | None = None, sealer: CacheSealer | None = None) -> None:
        self._entries: dict[bytes, NDArray[np.float32]] = {}
        self._path = None if path is None else Path(path)
        self._sealer = sealer
        self._changed = False
        self._lock = threading.Lock()
        if self._path is not None and sealer is not None and self._path.exists():
            self._entries = _unpacked(sealer.open(self._path.read_bytes(), context=CONTEXT))

    def __len__(self) -> int:
        return len(self._entries)

    def get(self, key: bytes) -> NDArray[np.float32] | None:
        """Embedding of ``key``, float32, shape (n,), or ``None``."""
        with self._lock:
            return self._entries.get(key)

    def put(self, key: bytes, embedding: NDArray[np.float32]) -> None:
        """Keep an embedding; on disk only after `flush`."""
        with self._lock:
            self._entries[key] = np.asarray(embedding, dtype=np.float32)
            self._changed = True

    def flush(self) -> None:
        """Write the file anew if anything changed; the old one stays until the new one is whole."""
        with self._lock:
            if self._path is None or self._sealer is None or not self._changed:
                return
            _replace(self._path, self._sealer.seal(_packed(self._entries), context=CONTEXT))
            self._changed = False


def _packed(entries: dict[bytes, NDArray[np.float32]]) -> bytes:
    arrays: dict[str, NDArray[np.generic]] = {}
    for n in {len(embedding) for embedding in entries.values()}:  # packs may share a file
        chosen = {key: value for key, value in entries.items() if len(value) == n}
        arrays[f"keys_{n}"] = np.array([list(key) for key in chosen], np.uint8)
        arrays[f"embeddings_{n}"] = np.stack(list(chosen.values()))
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **arrays)
    return file.getvalue()


def _unpacked(content: bytes) -> dict[bytes, NDArray[np.float32]]:
    entries: dict[bytes, NDArray[np.float32]] = {}
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            for name in arrays.files:
                if name.startswith("keys_"):
                    keys = arrays[name].astype(np.uint8, casting="safe")
                    embeddings = arrays[name.replace("keys", "embeddings")]
                    rows = embeddings.astype(np.float32, casting="safe")
                    entries.update(zip(map(bytes, keys), rows, strict=True))
    except (ValueError, TypeError, LookupError, OSError, EOFError, zipfile.BadZipFile):
        raise CacheError("The file is not an embedding cache of this version; delete it.") from None
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
    finally:
        Path(name).unlink(missing_ok=True)
