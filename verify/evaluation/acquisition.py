"""From the pictures of a set to descriptors: here, on a cluster, or from a file."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.cache import EmbeddingCache
from models.decoding import image_size
from models.extraction import CHUNK, EncodedImage, Extraction, Extractor, Failure
from models.pack import ModelPack
from verify.evaluation.backends import Backend, BackendError, spread
from verify.evaluation.embeddings_file import EmbeddingsFile, match
from verify.evaluation.verification_set import Indices, VerificationSet

Advance = Callable[[int], None]


@dataclass(frozen=True)
class PackSource:
    """Where a worker finds the model.

    Parameters
    ----------
    folder
        The pack; on a cluster the same path must lead to it on every worker.
    embedder_sha256
        What the embedder must be.
    providers, threads, flip
        As in :meth:`models.pack.ModelPack.load`.
    aligned
        Whether the photos are aligned crops.
    """

    folder: Path
    embedder_sha256: str
    providers: tuple[str, ...]
    threads: int | None
    flip: bool
    aligned: bool


@dataclass(frozen=True, eq=False, repr=False)
class Acquired:
    """Descriptors of the pictures of a set.

    Parameters
    ----------
    descriptors : (k, n) float32
        Unit rows of those that were acquired.
    rows : (len(pictures),) int64
        Row of each picture; -1 where it failed.
    failures
        The others, with the reason; ``path`` is the picture's name.
    """

    descriptors: NDArray[np.float32]
    rows: Indices
    failures: tuple[Failure, ...]


def read_pictures(pairs: VerificationSet) -> tuple[list[EncodedImage], str]:
    """Read all pictures.

    Returns
    -------
    pictures
        In the order of the set.
    digest
        SHA-256 over the SHA-256 of each picture in order: equal for equal photos, whatever holds
        them.
    """
    pictures = [picture.read() for picture in pairs.pictures]
    whole = hashlib.sha256()
    for picture in pictures:
        whole.update(hashlib.sha256(picture.data).digest())
    return pictures, whole.hexdigest()


def acquire(
    pictures: Sequence[EncodedImage],
    pack: ModelPack,
    source: PackSource,
    *,
    cache: EmbeddingCache | None,
    backend: Backend,
    progress: Advance,
) -> Acquired:
    """Embed pictures, ``CHUNK`` different ones at a time, here as there: the same descriptors.

    Raises
    ------
    BackendError
        The cluster cannot be used, or lacks the pack.
    """
    place: dict[str, int] = {}
    unique: list[EncodedImage] = []
    content = [hashlib.sha256(picture.data).hexdigest() for picture in pictures]
    for picture, digest in zip(pictures, content, strict=True):
        if digest not in place:
            place[digest] = len(unique)
            unique.append(picture)
    done: list[Extraction] = []
    if backend.scheduler is None:
        extractor = Extractor(pack, aligned=source.aligned, cache=cache)
        done.append(extractor.extract(unique, progress=progress))
    else:
        chunks = [unique[start : start + CHUNK] for start in range(0, len(unique), CHUNK)]
        ready = {}
        for index, extraction in spread(backend, _extract, source, chunks):
            ready[index] = extraction
            progress(len(chunks[index]))
        done += [ready[index] for index in range(len(chunks))]
    return _gathered(pictures, unique, content, place, done, pack)


def _gathered(
    pictures: Sequence[EncodedImage],
    unique: Sequence[EncodedImage],
    content: Sequence[str],
    place: dict[str, int],
    done: Sequence[Extraction],
    pack: ModelPack,
) -> Acquired:
    row_of: dict[str, int] = {}
    reason_of: dict[str, Failure] = {}
    rows: list[NDArray[np.float32]] = []
    for extraction in done:
        rows.append(extraction.descriptors)
        for path in extraction.paths:
            row_of[str(path)] = len(row_of)
        reason_of |= {str(failure.path): failure for failure in extraction.failures}
    names = [str(Path(unique[place[digest]].name)) for digest in content]
    return Acquired(
        np.concatenate([np.empty((0, pack.info.n), np.float32), *rows]),
        np.array([row_of.get(name, -1) for name in names], dtype=np.int64),
        tuple(
            Failure(Path(picture.name), reason_of[name].code, reason_of[name].reason)
            for picture, name in zip(pictures, names, strict=True)
            if name not in row_of
        ),
    )


@lru_cache(maxsize=2)
def _loaded(source: PackSource) -> ModelPack:
    if not source.folder.exists():
        raise BackendError(
            f"a worker does not find the pack {source.folder}: it must lie at the same path there"
        )
    pack = ModelPack.load(
        source.folder, providers=source.providers, threads=source.threads, flip=source.flip
    )
    if pack.info.embedder_sha256 != source.embedder_sha256:
        raise BackendError(f"a worker has another embedder in the pack {source.folder}")
    return pack


def _extract(source: PackSource, chunk: list[EncodedImage]) -> Extraction:
    return Extractor(_loaded(source), aligned=source.aligned).extract(chunk, progress=False)


def from_file(pairs: VerificationSet, embeddings: EmbeddingsFile) -> Acquired:
    """Take the descriptors of a set from a file of embeddings; absent ones failed to acquire."""
    positions = match(embeddings, pairs)
    found = positions >= 0
    rows = np.full(len(positions), -1, dtype=np.int64)
    rows[found] = np.arange(int(found.sum()))
    return Acquired(
        np.ascontiguousarray(embeddings.descriptors[positions[found]]),
        rows,
        tuple(
            Failure(Path(picture.name), "not_in_file", "The file of embeddings lacks the photo.")
            for picture, there in zip(pairs.pictures, found.tolist(), strict=True)
            if not there
        ),
    )


def are_aligned(pictures: Sequence[EncodedImage], size: int) -> bool:
    """Whether the pictures, as far as they are any, have exactly the embedder's input size.

    Photos out of a camera, and those of LFW (250 × 250), are larger.
    """
    sizes = {image_size(picture.data) for picture in pictures} - {None}
    return sizes == {(size, size)}
