"""From the pictures of a set to descriptors: by a model pack, or from a file."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.decoding import image_size
from models.extraction import Extractor, Failure, named
from verify.evaluation.embeddings_file import EmbeddingsFile, match
from verify.evaluation.verification_set import Indices, Picture, VerificationSet

Advance = Callable[[int], None]


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
    extractor: Extractor,
    *,
    progress: Advance,
) -> Acquired:
    """Embed the pictures of a set.

    Parameters
    ----------
    contents
        What :func:`digests` says of the set; equal pictures are embedded once.
    """
    place: dict[str, int] = {}
    unique: list[Picture] = []
    for picture, content in zip(pairs.pictures, contents, strict=True):
        if content and place.setdefault(content, len(unique)) == len(unique):
            unique.append(picture)
    progress(len(pairs.pictures) - len(unique))
    sources = [picture.source for picture in unique]
    extraction = extractor.extract(sources, progress=progress)
    row_of = {str(path): row for row, path in enumerate(extraction.paths)}
    reason_of = {str(failure.path): failure for failure in extraction.failures}
    reason_of[""] = Failure(Path(), "unreadable_file", "The file cannot be read.")
    names = [str(named(sources[place[content]])) if content else "" for content in contents]
    return Acquired(
        extraction.descriptors,
        np.array([row_of.get(name, -1) for name in names], dtype=np.int64),
        tuple(
            Failure(Path(picture.name), reason_of[name].code, reason_of[name].reason)
            for picture, name in zip(pairs.pictures, names, strict=True)
            if name not in row_of
        ),
        extraction.mirrored,
    )


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
