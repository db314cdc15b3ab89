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
from models.extraction import (
    CHUNK,
    EncodedImage,
    Extraction,
    Extractor,
    Failure,
    MarkedPhoto,
    named,
)
from models.pack import ModelPack
from verify.evaluation.backends import Backend, BackendError, spread
from verify.evaluation.embeddings_file import EmbeddingsFile, match
from verify.evaluation.verification_set import Indices, Picture, VerificationSet

Advance = Callable[[int], None]


@dataclass(frozen=True)
class PackSource:
    """Where a worker finds the model.

    Parameters
    ----------
    folder
        The pack; on a cluster the same path must lead to it on every worker.
    providers, threads, flip
        As in :meth:`models.pack.ModelPack.load`.
    """

    folder: Path
    embedder_sha256: str
    providers: tuple[str, ...]
    threads: int | None
    flip: bool
    aligned: bool
    mirrored: bool = False


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
    mirrored : (k, n) float32, optional
        The same rows with the mirror image added.
    """

    descriptors: NDArray[np.float32]
    rows: Indices
    failures: tuple[Failure, ...]
    mirrored: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class EmbeddedSet:
    """A set with its embeddings.

    Parameters
    ----------
    aligned
        Whether its photos were taken for aligned crops; None where they were not embedded here.
    pictures_sha256
        Of all pictures; empty where they were not read.
    """

    pairs: VerificationSet
    acquired: Acquired
    aligned: bool | None
    pictures_sha256: str


def digests(pairs: VerificationSet) -> list[str]:
    """SHA-256 of every picture, in the order of the set; a picture that cannot be read has none.

    One picture is in memory at a time.
    """
    contents = []
    for picture in pairs.pictures:
        try:
            contents.append(hashlib.sha256(picture.read()).hexdigest())
        except OSError:
            contents.append("")
    return contents


def digest_of_pictures(contents: Sequence[str]) -> str:
    """Name the pictures of a set: equal for equal photos in equal order, whatever holds them."""
    return hashlib.sha256("".join(contents).encode()).hexdigest()


def acquire(
    pairs: VerificationSet,
    contents: Sequence[str],
    pack: ModelPack,
    source: PackSource,
    *,
    cache: EmbeddingCache | None,
    backend: Backend,
    progress: Advance,
) -> Acquired:
    """Embed the pictures of a set, ``CHUNK`` different ones at a time, here as there.

    Parameters
    ----------
    contents
        What :func:`digests` says of the set; equal pictures are embedded once.

    Raises
    ------
    BackendError
        The cluster cannot be used, or lacks the pack.
    """
    place: dict[str, int] = {}
    unique: list[Picture] = []
    for picture, content in zip(pairs.pictures, contents, strict=True):
        if content and place.setdefault(content, len(unique)) == len(unique):
            unique.append(picture)
    progress(len(pairs.pictures) - len(unique))
    done: list[Extraction]
    if backend.scheduler is None:
        extractor = Extractor(pack, aligned=source.aligned, cache=cache, mirrored=source.mirrored)
        sources = [picture.source for picture in unique]
        done = [extractor.extract(sources, progress=progress)]
        keys = [str(named(photo)) for photo in sources]
    else:
        keys = [picture.name for picture in unique]
        chunks = [unique[start : start + CHUNK] for start in range(0, len(unique), CHUNK)]
        ready = {}
        for index, extraction in spread(backend, _extract, source, map(_loaded_chunk, chunks)):
            ready[index] = extraction
            progress(len(chunks[index]))
        done = [ready[index] for index in range(len(chunks))]
    row_of: dict[str, int] = {}
    reason_of: dict[str, Failure] = {}
    for extraction in done:
        for path in extraction.paths:
            row_of[str(path)] = len(row_of)
        reason_of |= {str(failure.path): failure for failure in extraction.failures}
    names = [str(Path(keys[place[content]])) if content else "" for content in contents]
    reason_of[""] = Failure(Path(), "unreadable_file", "The file cannot be read.")
    rows = [extraction.descriptors for extraction in done]
    mirrored = [e.mirrored for e in done if e.mirrored is not None]
    return Acquired(
        np.concatenate([np.empty((0, pack.info.n), np.float32), *rows]),
        np.array([row_of.get(name, -1) for name in names], dtype=np.int64),
        tuple(
            Failure(Path(picture.name), reason_of[name].code, reason_of[name].reason)
            for picture, name in zip(pairs.pictures, names, strict=True)
            if name not in row_of
        ),
        np.concatenate(mirrored) if mirrored else None,
    )


def _loaded_chunk(chunk: Sequence[Picture]) -> list[EncodedImage | MarkedPhoto]:
    photos = [(EncodedImage(picture.name, picture.read()), picture.keypoints) for picture in chunk]
    return [photo if marks is None else MarkedPhoto(photo, marks) for photo, marks in photos]


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


def _extract(source: PackSource, chunk: list[EncodedImage | MarkedPhoto]) -> Extraction:
    extractor = Extractor(_loaded(source), aligned=source.aligned, mirrored=source.mirrored)
    return extractor.extract(chunk, progress=False)


def from_file(pairs: VerificationSet, embeddings: EmbeddingsFile) -> Acquired:
    """Take the descriptors of a set from a file of embeddings; absent ones failed to acquire."""
    positions = match(embeddings, pairs)
    present = positions >= 0
    rows = np.full(len(positions), -1, dtype=np.int64)
    rows[present] = np.arange(int(present.sum()))
    return Acquired(
        np.ascontiguousarray(embeddings.descriptors[positions[present]]),
        rows,
        tuple(
            Failure(Path(picture.name), "not_in_file", "The file of embeddings lacks the photo.")
            for picture, there in zip(pairs.pictures, present.tolist(), strict=True)
            if not there
        ),
    )


def are_aligned(pairs: VerificationSet, size: int) -> bool:
    """Whether all pictures, as far as they are any, have exactly the embedder's input size.

    Photos out of a camera, and those of LFW (250 × 250), are larger.
    """
    any_read = False
    for picture in pairs.pictures:
        try:
            size_read = image_size(picture.read())
        except OSError:
            continue
        if size_read not in (None, (size, size)):
            return False
        any_read = any_read or size_read is not None
    return any_read
