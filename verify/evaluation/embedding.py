"""From the photos of a set to embeddings: by a model pack, or from a file that has them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from models.cache import EmbeddingCache
from models.decoding import image_size
from models.extraction import Extractor, Failure
from models.pack import ModelPack
from verify.evaluation.embeddings_file import EmbeddingsFile, match
from verify.evaluation.plan import EvaluationError, Json
from verify.evaluation.provenance import model_facts
from verify.evaluation.verification_set import Indices, VerificationSet

Advance = Callable[[int], None]
Progress = Callable[[str, int], AbstractContextManager[Advance]]
"""Begins a task of so many steps; gives what is called with the steps done since the last call."""


@dataclass(frozen=True, eq=False, repr=False)
class EmbeddedSet:
    """A set with the embeddings of its photos."""

    pairs: VerificationSet
    embeddings: NDArray[np.float32]  # (k, n) unit rows
    rows: Indices  # of each photo; -1 where it failed
    failures: tuple[Failure, ...]  # the others; ``path`` is the photo's name
    aligned: bool | None = None  # None where the photos were not embedded here


@dataclass(frozen=True, eq=False)
class FileEmbedder:
    """Embeddings that were computed elsewhere."""

    file: EmbeddingsFile
    name: str

    @property
    def model(self) -> Json:
        """Dimension, name and SHA-256 of the file."""
        n = int(self.file.embeddings.shape[1])
        return {"n": n, "embeddings": self.name, "sha256": self.file.sha256}

    def embed(
        self, pairs: VerificationSet, *, cache: EmbeddingCache | None, progress: Progress
    ) -> EmbeddedSet:
        """Take the embeddings of a set from the file; absent ones failed to acquire."""
        del cache, progress
        positions = match(self.file, pairs)
        present = positions >= 0
        return EmbeddedSet(
            pairs,
            np.ascontiguousarray(self.file.embeddings[positions[present]]),
            np.where(present, np.cumsum(present) - 1, -1),
            tuple(
                Failure(Path(pairs.pictures[place].name), "not_in_file", "The file lacks it.")
                for place in np.flatnonzero(~present).tolist()
            ),
        )


@dataclass(frozen=True, eq=False)
class PackEmbedder:
    """A model pack."""

    pack: ModelPack
    facts: Json
    aligned: bool | None  # None to see for each set

    @property
    def model(self) -> Json:
        """What a contract binds of the pack, and the recorded facts."""
        return model_facts(self.pack.info, self.facts)

    def embed(
        self, pairs: VerificationSet, *, cache: EmbeddingCache | None, progress: Progress
    ) -> EmbeddedSet:
        """Embed the photos of a set; those that fail are counted."""
        aligned = self._aligned(pairs)
        photos = [replace(one, name=str(place)) for place, one in enumerate(pairs.pictures)]
        extractor = Extractor(self.pack, aligned=aligned, cache=cache)
        with progress(f"embedding {pairs.name}", len(photos)) as advance:
            extraction = extractor.extract(photos, progress=advance)
        rows = np.full(len(photos), -1, dtype=np.int64)
        rows[[int(path.name) for path in extraction.paths]] = np.arange(len(extraction.paths))
        failures = tuple(
            replace(failure, path=Path(pairs.pictures[int(failure.path.name)].name))
            for failure in extraction.failures
        )
        return EmbeddedSet(pairs, extraction.embeddings, rows, failures, aligned)

    def _aligned(self, pairs: VerificationSet) -> bool:
        size = int(self.pack.info.preprocessing["size"])
        aligned = pairs.aligned if self.aligned is None else self.aligned
        if aligned is None:
            aligned = are_aligned(pairs, size)
        if not aligned and self.pack.info.detector is None:
            raise EvaluationError(
                f"the pack has no detector, and the photos of {pairs.name} are not all crops of "
                f"{size} x {size}: use a pack with a detector, or say that they are "
                "crops of another size (aligned)"
            )
        return aligned


Embedder = PackEmbedder | FileEmbedder


def are_aligned(pairs: VerificationSet, size: int) -> bool:
    """Whether all photos, as far as they are any, have exactly the embedder's input size.

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
