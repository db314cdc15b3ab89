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
_KEPT_SECONDS = 60.0
"""Between two writes of the cache, which a killed run loses; of large caches more."""

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


@dataclass(eq=False)
class _File:
    """One file on its way: its crop, then its embedding; or why there is none."""

    path: Path
    key: bytes = field(default=b"", repr=False)
    crop: NDArray[np.uint8] | None = field(default=None, repr=False)
    embedding: NDArray[np.float32] | None = field(default=None, repr=False)
    is_cached: bool = False
    failure: Failure | None = None


class Extractor:
    """Embeds files with one pack.

    Of several faces the most central is taken, since labelled sets state whom a photo shows, and
    bystanders are common. Every upright face will do, as in public protocols.

    Parameters
    ----------
    cache
        Where known embeddings are kept; ``None`` keeps none beyond this extractor.
    aligned
        Photos are aligned crops: no face is looked for.
    """

    def __init__(
        self,
        pack: ModelPack,
        *,
        cache: EmbeddingCache | None = None,
        aligned: bool = False,
    ) -> None:
        self._pack = pack
        self._cache = EmbeddingCache() if cache is None else cache
        self._aligned = aligned or pack.info.detector is None
        self._digest = self._settings_digest()

    def extract(
        self, photos: Iterable[Path | Photo], *, progress: Advance | None = None
    ) -> Extraction:
        """Embed photos."""
        given = [one if isinstance(one, Photo) else Photo(str(one), one) for one in photos]
        files: list[_File] = []
        write_at = time.monotonic() + _KEPT_SECONDS
        try:
            with ThreadPoolExecutor(default_workers()) as pool:
                for start in range(0, len(given), CHUNK):
                    chunk = list(pool.map(self._prepared, given[start : start + CHUNK]))
                    self._embed(chunk)
                    files += chunk
                    if progress is not None:
                        progress(len(chunk))
                    if (now := time.monotonic()) > write_at:
                        self._cache.flush()
                        written = time.monotonic()
                        write_at = written + max(_KEPT_SECONDS, 20 * (written - now))
        finally:
            self._cache.flush()
        rows = [file.embedding for file in files if file.embedding is not None]
        return Extraction(
            embeddings=np.stack(rows) if rows else np.empty((0, self._pack.info.n), np.float32),
            paths=[file.path for file in files if file.failure is None],
            failures=[file.failure for file in files if file.failure is not None],
            cached=sum(file.is_cached for file in files),
        )

    def _settings_digest(self) -> bytes:
        """Everything besides the picture that an embedding depends on."""
        info = self._pack.info
        detector = None
        if not self._aligned and info.detector is not None:
            detector = [info.detector.sha256, list(info.detector.input_size)]
        settings = {
            "embedder": info.embedder_sha256,
            "preprocessing": info.preprocessing,
            "detector": detector,
            "turned": "refused",
        }
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).digest()

    def _prepared(self, photo: Photo) -> _File:
        """Read, look up, decode, find the face; whatever is wrong with the file is an answer."""
        file = _File(Path(photo.name))
        try:
            data = photo.read()
            file.key = hashlib.sha256(self._digest + hashlib.sha256(data).digest()).digest()
            file.embedding = self._cache.get(file.key)
            file.is_cached = file.embedding is not None
            if file.is_cached:
                return file
            if self._aligned:
                file.crop = self._pack.as_aligned(decode_image(data))
            else:
                file.crop = self._pack.crop_photo(data, policy=None, quality=None).crop
        except (ImageError, FaceError) as error:
            file.failure = Failure(file.path, error.code, str(error))
        except OSError as error:
            reason = f"The file cannot be read: {error.strerror}."
            file.failure = Failure(file.path, "unreadable_file", reason)
        return file

    def _embed(self, chunk: Sequence[_File]) -> None:
        """Embed the crops of a chunk in batches; copies of one file are computed once."""
        crops = {file.key: file.crop for file in chunk if file.crop is not None}
        if not crops:
            return
        made = dict(zip(crops, self._pack.embed(np.stack(list(crops.values()))), strict=True))
        for key, embedding in made.items():
            self._cache.put(key, embedding)
        for file in chunk:
            if file.crop is not None:
                file.embedding, file.crop = made[file.key], None
