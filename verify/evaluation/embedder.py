"""Where the embeddings of a set come from: a pack that computes them, or a file that has them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from verify.evaluation.acquisition import (
    EmbeddedSet,
    acquire,
    are_aligned,
    digest_of_pictures,
    digests,
    from_file,
)
from verify.evaluation.embeddings_file import EmbeddingsFile
from verify.evaluation.plan import EvaluationError
from verify.evaluation.results import Model
from verify.evaluation.rows import Json
from verify.evaluation.verification_set import VerificationSet

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Begins a task of so many steps; gives what is called with the steps done since the last call."""


@dataclass(frozen=True, eq=False)
class FileEmbedder:
    """Embeddings that were computed elsewhere."""

    file: EmbeddingsFile
    name: str

    @property
    def model(self) -> Model:
        """Name and SHA-256 of the file."""
        facts: Json = {"embeddings": self.name, "sha256": self.file.sha256}
        return Model(int(self.file.descriptors.shape[1]), facts)

    def embed(
        self,
        pairs: VerificationSet,
        *,
        cache: EmbeddingCache | None,
        progress: Progress,
    ) -> EmbeddedSet:
        """Take the embeddings of a set from the file; absent ones failed to acquire."""
        del cache, progress
        return EmbeddedSet(pairs, from_file(pairs, self.file), None, "")


@dataclass(frozen=True, eq=False)
class PackEmbedder:
    """A model pack.

    Parameters
    ----------
    mirrored
        Whether embeddings with the mirror image are wanted beside those without.
    aligned
        Whether the photos are aligned crops; None to see for each set.
    """

    pack: ModelPack
    facts: Json
    mirrored: bool
    aligned: bool | None

    @property
    def model(self) -> Model:
        """What a contract binds of the pack, and the recorded facts."""
        info = self.pack.info
        return Model(info.n, self.facts, info.embedder_sha256, info.preprocessing)

    def embed(
        self,
        pairs: VerificationSet,
        *,
        cache: EmbeddingCache | None,
        progress: Progress,
    ) -> EmbeddedSet:
        """Embed the photos of a set; those that fail are counted.

        Raises
        ------
        EvaluationError
            Nothing can align the photos.
        """
        contents = digests(pairs)
        aligned = self._aligned(pairs)
        extractor = Extractor(self.pack, aligned=aligned, cache=cache, mirrored=self.mirrored)
        with progress(f"embedding {pairs.name}", len(pairs.pictures)) as advance:
            acquired = acquire(pairs, contents, extractor, progress=advance)
        return EmbeddedSet(pairs, acquired, aligned, digest_of_pictures(contents))

    def _aligned(self, pairs: VerificationSet) -> bool:
        size = int(self.pack.info.preprocessing["size"])
        aligned = pairs.aligned if self.aligned is None else self.aligned
        if aligned is None:
            aligned = are_aligned(pairs, size)
        marked = all(picture.keypoints is not None for picture in pairs.pictures)
        if not aligned and not marked and self.pack.info.detector is None:
            raise EvaluationError(
                f"the pack has no detector, and the photos of {pairs.name} are not all crops of "
                f"{size} x {size}: use a pack with a detector, or say that they are "
                "crops of another size (aligned)"
            )
        return aligned


Embedder = PackEmbedder | FileEmbedder
