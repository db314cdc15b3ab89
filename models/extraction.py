"""Embed many files: in parallel, with a cache, and with an account of every file that failed."""

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.cache import EmbeddingCache
from models.decoding import MAX_BYTES, decode_image
from models.errors import FaceError, ImageError
from models.pack import ModelPack
from models.sessions import default_workers

CHUNK = 128
"""Photos embedded together. Their crops are in memory at once, photos only one per thread."""
_KEPT_SECONDS = 15.0
"""Between two writes of the cache, at least: what a killed run loses."""

Advance = Callable[[int], None]


@dataclass(frozen=True)
class Photo:
    """A photo by a name of its own, which stands for it in an :class:`Extraction`."""

    name: str
    source: Path | bytes = field(repr=False)

    def read(self) -> bytes:
        """Read the encoded photo; of a larger file one byte more than the decoder accepts."""
        if isinstance(self.source, bytes):
            return self.source
        with self.source.open("rb") as file:
            return file.read(MAX_BYTES + 1)


@dataclass(frozen=True)
class Failure:
    """A file from which no embedding was acquired, and why."""

    path: Path
    code: str
    reason: str


@dataclass(frozen=True, eq=False)
class Extraction:
    """Result of one bulk run."""

    embeddings: NDArray[np.float32] = field(repr=False)  # (k, n) unit rows, in the order of `paths`
    paths: list[Path]  # that were embedded, in the order in which they were given
    failures: list[Failure]  # all others
    cached: int

    @property
    def attempts(self) -> int:
        """Number of files that were tried."""
        return len(self.paths) + len(self.failures)

    def failure_counts(self) -> dict[str, int]:
        """Failures by code, most frequent first."""
        return dict(Counter(failure.code for failure in self.failures).most_common())


class Extractor:
    """Embeds files with one pack.

    Of several faces the most central is taken, since labelled sets state whom a photo shows, and
    bystanders are common. Every upright face will do, as in public protocols.

    Parameters
    ----------
    cache
        Where known embeddings are kept; ``None`` computes all anew.
    """

    def __init__(
        self,
        pack: ModelPack,
        *,
        cache: EmbeddingCache | None = None,
        aligned: bool = False,
    ) -> None:
        self._pack = pack
        self._cache = cache
        self._aligned = aligned or pack.info.detector is None
        self._kind = self._settings_digest()

    def extract(
        self, photos: Iterable[Path | Photo], *, progress: Advance | None = None
    ) -> Extraction:
        """Embed photos."""
        files = [one if isinstance(one, Photo) else Photo(str(one), one) for one in photos]
        prepared: list[_Prepared] = []
        keep_after = time.monotonic() + _KEPT_SECONDS
        try:
            with ThreadPoolExecutor(default_workers()) as pool:
                for start in range(0, len(files), CHUNK):
                    chunk = list(pool.map(self._prepare, files[start : start + CHUNK]))
                    prepared += self._embedded(chunk)
                    if progress is not None:
                        progress(len(chunk))
                    keep_after = self._keep(keep_after)
        finally:
            if self._cache is not None:
                self._cache.flush()
        done = [(Path(file.name), item) for file, item in zip(files, prepared, strict=True)]
        rows = [item.embedding for _, item in done if item.embedding is not None]
        return Extraction(
            np.stack(rows) if rows else np.empty((0, self._pack.info.n), np.float32),
            [path for path, item in done if item.failure is None],
            [item.failure for item in prepared if item.failure is not None],
            sum(item.is_cached for item in prepared),
        )

    def _keep(self, after: float) -> float:
        """Write the cache if it is time to; when to do so next, however large the file grows."""
        began = time.monotonic()
        if self._cache is None or began < after:
            return after
        self._cache.flush()
        ended = time.monotonic()
        return ended + max(_KEPT_SECONDS, 20 * (ended - began))

    def _settings_digest(self) -> bytes:
        """Everything besides the picture that an embedding depends on."""
        info = self._pack.info
        detector = None
        if not self._aligned and info.detector is not None:
            detector = [info.detector.sha256, list(info.detector.input_size)]
        settings = {
            "embedder": info.embedder_sha256,
            "preprocessing": dict(info.preprocessing),
            "detector": detector,
            "turned": "refused",
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).digest()

    def _prepare(self, photo: Photo) -> "_Prepared":
        """Read, look up, decode, find the face; whatever is wrong with the file is an answer."""
        path = Path(photo.name)
        try:
            data = photo.read()
            key = hashlib.sha256(self._kind + hashlib.sha256(data).digest()).digest()
            embedding = None if self._cache is None else self._cache.get(key)
            if embedding is not None:
                return _Prepared(key, embedding=embedding, is_cached=True)
            if self._aligned:
                crop = self._pack.as_aligned(decode_image(data))
            else:
                crop = self._pack.crop_photo(data, policy=None, quality=None).crop
            return _Prepared(key, crop=crop)
        except (ImageError, FaceError) as error:
            return _Prepared(b"", failure=Failure(path, error.code, str(error)))
        except OSError as error:
            reason = f"The file cannot be read: {error.strerror}."
            return _Prepared(b"", failure=Failure(path, "unreadable_file", reason))

    def _embedded(self, chunk: Sequence["_Prepared"]) -> list["_Prepared"]:
        """Embed the crops of a chunk in batches; copies of one file are computed once."""
        unique = {item.key: item.crop for item in chunk if item.crop is not None}
        if not unique:
            return list(chunk)
        crops = np.stack(list(unique.values()))
        made = dict(zip(unique, self._pack.embed(crops), strict=True))
        if self._cache is not None:
            for key, embedding in made.items():
                self._cache.put(key, embedding)
        return [
            item if item.crop is None else _Prepared(item.key, embedding=made[item.key])
            for item in chunk
        ]


@dataclass(frozen=True, eq=False)
class _Prepared:
    """One file: its crop, which is to be embedded, its embedding, or why there is none."""

    key: bytes = field(repr=False)
    crop: NDArray[np.uint8] | None = field(default=None, repr=False)
    embedding: NDArray[np.float32] | None = field(default=None, repr=False)
    is_cached: bool = False
    failure: Failure | None = None
