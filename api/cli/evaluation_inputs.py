"""What ``veilface evaluate`` works on: descriptors of the sets, decoys, and attributes."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from api.cli.console import message, progress
from api.cli.descriptors import bulk_pack
from api.cli.errors import CommandError, UsageError
from api.process.opening import file_sealer, open_keyring
from api.process.preparation import recorded_of, require_made_with
from api.settings import Settings
from models.cache import EmbeddingCache
from models.pack import ModelPack
from models.sessions import default_workers
from templates.decoys import Attributes, DecoyGenerator, DecoyPool, load_source
from templates.decoys.pool import POOL_MAGIC
from templates.keys.sealing import Sealer
from verify.evaluation.acquisition import (
    Acquired,
    PackSource,
    acquire,
    are_aligned,
    digest_of_pictures,
    digests,
    from_file,
)
from verify.evaluation.attributes import predict_attributes, resembling
from verify.evaluation.backends import Backend
from verify.evaluation.embeddings_file import EmbeddingsFile, read_embeddings
from verify.evaluation.labels_file import Labels
from verify.evaluation.material import Material
from verify.evaluation.results import Model, SourceFacts
from verify.evaluation.rows import Json
from verify.evaluation.verification_set import VerificationSet

NO_PACK = "none"
SAME_PERSON = 0.4
"""Cosine from which a decoy counts as a person of the test set. Of 29.6 million pairs of photos of
two people of LFW 54 reach it, and some of those are one person under two names."""


@dataclass(frozen=True, eq=False)
class Descriptors:
    """Where descriptors come from: a pack that computes them, or a file that has them.

    Parameters
    ----------
    pack
        The pack as it is named.
    mirrored
        Whether descriptors with the mirror image are wanted beside those without.
    file
        Descriptors that were computed elsewhere.
    """

    pack: ModelPack | None
    mirrored: bool
    file: EmbeddingsFile | None
    file_name: str = ""

    @property
    def n(self) -> int:
        """Their dimension."""
        if self.pack is not None:
            return self.pack.info.n
        assert self.file is not None  # noqa: S101 - one of both is there
        return int(self.file.descriptors.shape[1])

    @property
    def model(self) -> Model:
        """What the results say about them."""
        if self.pack is None:
            assert self.file is not None  # noqa: S101 - one of both is there
            return Model(self.n, {"embeddings": self.file_name, "sha256": self.file.sha256})
        info = self.pack.info
        return Model(self.n, recorded_of(self.pack), info.embedder_sha256, info.preprocessing)


def open_descriptors(
    settings: Settings, embeddings: Path | None, *, flip: bool, both: bool
) -> Descriptors:
    """Open the pack or the file of embeddings.

    Parameters
    ----------
    flip
        Add the mirror image everywhere.
    both
        Compare raw descriptors with the mirror image too.

    Raises
    ------
    UsageError
        Both are named, or neither.
    """
    no_pack = settings.pack is None or str(settings.pack) == NO_PACK
    if embeddings is None:
        why = "embeddings come from a model pack; without one, give --pack none --embeddings FILE"
        if no_pack:
            raise UsageError(why)
        pack = bulk_pack(settings, flip=flip, why=why)
        return Descriptors(pack, both, None)
    if not no_pack:
        raise UsageError("give a pack, or --pack none and --embeddings, not both")
    if flip:
        raise UsageError("--flip needs a pack: embeddings in a file are as they are")
    return Descriptors(None, False, read_embeddings(embeddings), embeddings.name)


@dataclass(frozen=True, eq=False)
class Faces:
    """A set with its descriptors."""

    pairs: VerificationSet
    acquired: Acquired
    aligned: bool | None
    pictures_sha256: str


def acquire_faces(
    pairs: VerificationSet,
    descriptors: Descriptors,
    settings: Settings,
    *,
    aligned: bool | None,
    cache: EmbeddingCache | None,
    backend: Backend,
) -> Faces:
    """Get the descriptors of a set.

    Raises
    ------
    CommandError
        No photo gave one, or nothing can align the photos.
    """
    if descriptors.file is not None:
        faces = Faces(pairs, from_file(pairs, descriptors.file), None, "")
    else:
        assert descriptors.pack is not None  # noqa: S101 - one of both is there
        contents = digests(pairs)
        size = int(descriptors.pack.info.preprocessing["size"])
        crops = pairs.aligned if aligned is None else aligned
        if crops is None:
            crops = are_aligned(pairs, size)
        marked = all(picture.keypoints is not None for picture in pairs.pictures)
        if not crops and not marked and descriptors.pack.info.detector is None:
            raise CommandError(
                f"the pack has no detector, and the photos of {pairs.name} are not all crops of "
                f"{size} x {size}: use a pack with a detector, or say --aligned if they are "
                "aligned crops of another size"
            )
        source = PackSource(
            folder=Path(str(settings.pack)).expanduser().resolve(),
            embedder_sha256=descriptors.pack.info.embedder_sha256,
            providers=settings.providers,
            threads=None if backend.scheduler is None else 1,
            flip=bool(descriptors.pack.info.preprocessing["flip"]),
            aligned=crops,
            mirrored=descriptors.mirrored,
        )
        with progress(f"embedding {pairs.name}", len(pairs.pictures)) as advance:
            acquired = acquire(
                pairs,
                contents,
                descriptors.pack,
                source,
                cache=cache,
                backend=backend,
                progress=advance,
            )
        faces = Faces(pairs, acquired, crops, digest_of_pictures(contents))
    if not len(faces.acquired.descriptors):
        raise CommandError(
            f"{pairs.name}: no photo gave an embedding, the first because of "
            f"{faces.acquired.failures[0].code}; do --aligned and --embeddings fit?"
        )
    if faces.acquired.failures:
        message(
            f"note: {pairs.name}: {len(faces.acquired.failures)} of {len(pairs.pictures)} photos "
            "skipped; the results list them"
        )
    return faces


def open_sources(
    files: Sequence[Path], settings: Settings, descriptors: Descriptors
) -> list[SourceFacts]:
    """Load decoy files, and check that they fit.

    Raises
    ------
    CommandError, UsageError
        They have another dimension, or are of one kind twice.
    ContractMismatch
        They were made with another model.
    """
    sources = []
    for file in files:
        with file.open("rb") as stream:
            is_pool = stream.read(len(POOL_MAGIC)) == POOL_MAGIC
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        # A generator is not sealed, and needs no key.
        source: DecoyPool | DecoyGenerator = (
            load_source(file, file_sealer(open_keyring(settings)))
            if is_pool
            else DecoyGenerator.load(file)
        )
        if source.n != descriptors.n:
            raise CommandError(
                f"{file.name} has decoys of {source.n} numbers each, the embeddings have "
                f"{descriptors.n}; build the decoys with this pack"
            )
        if descriptors.pack is not None:
            require_made_with(source, descriptors.pack)
        sources.append(SourceFacts(source, file.name, digest))
    kinds = [isinstance(each.source, DecoyPool) for each in sources]
    if len(set(kinds)) != len(kinds):
        raise UsageError("give one pool and one generator at most: rows name the kind only")
    return sources


def without_test_people(sources: Sequence[SourceFacts], faces: Faces) -> list[SourceFacts]:
    """Leave pool entries out that resemble a person of the set.

    Whoever was not acquired, or resembles their own photos less than ``SAME_PERSON``, stays in;
    ``resemblance`` says how many genuine pairs that concerns.

    Raises
    ------
    CommandError
        None is left.
    """
    kept = []
    for each in sources:
        if not isinstance(each.source, DecoyPool):
            kept.append(each)
            continue
        pool = each.source
        gone = resembling(pool, faces.acquired.descriptors, cosine=SAME_PERSON)
        if len(gone) == len(pool):
            raise CommandError(
                f"every face of {each.file} resembles one of {faces.pairs.name}; build it from "
                "other people"
            )
        if len(gone):
            message(
                f"note: {faces.pairs.name}: {len(gone)} of {len(pool)} decoys resemble its people "
                f"(cosine {SAME_PERSON:g} or more) and are left out"
            )
            pool = pool.subset(np.setdiff1d(np.arange(len(pool)), gone))
        kept.append(replace(each, source=pool, left_out=len(gone)))
    return kept


def resemblance(material: Material) -> Json:
    """State from which cosine decoys were left out, and which share of genuine pairs is below."""
    rows = material.descriptors
    first, second = rows[material.first[material.same]], rows[material.second[material.same]]
    cosines = np.einsum("ij,ij->i", first, second, dtype=np.float64)
    return {"cosine": SAME_PERSON, "genuine_below": float(np.mean(cosines < SAME_PERSON))}


def attributes_of(
    faces: Faces, labels: Labels | None, sources: Sequence[SourceFacts]
) -> tuple[list[Attributes], int]:
    """Gender and race of every acquired row: as labelled, else predicted from the pool.

    Returns
    -------
    attributes
        One for each row.
    predicted
        How many were predicted.
    """
    pool = next(
        each.source
        for each in sources
        if isinstance(each.source, DecoyPool) and each.source.labelled
    )
    vocabulary = _vocabulary(pool)
    found = predict_attributes(faces.acquired.descriptors, pool)
    predicted = len(found)
    for picture, row in zip(faces.pairs.pictures, faces.acquired.rows.tolist(), strict=True):
        own = {} if labels is None or row < 0 else labels.find(picture.name)
        if {"gender", "race"} <= own.keys():
            for attribute in ("gender", "race"):
                if own[attribute] not in vocabulary[attribute]:
                    known = ", ".join(sorted(vocabulary[attribute]))
                    raise CommandError(
                        f"the label file says {attribute} {own[attribute]!r} of {picture.name}; "
                        f"the decoy pool knows {known}: hybrid+ needs one vocabulary for both"
                    )
            found[row] = Attributes(gender=own["gender"], race=own["race"])
            predicted -= 1
    return found, predicted


def _vocabulary(pool: DecoyPool) -> dict[str, set[str]]:
    labels = pool.entries[1] or ()
    return {
        "gender": {label.gender for label in labels if label.gender is not None},
        "race": {label.race for label in labels if label.race is not None},
    }


def open_cache(cache: Path | None, settings: Settings) -> EmbeddingCache | None:
    """Open the sealed cache of embeddings, where one is named."""
    if cache is None:
        return None
    sealer: Sealer = file_sealer(open_keyring(settings))
    return EmbeddingCache.open_file(cache, sealer)


def default_jobs() -> int:
    """Processes: as many as processors, 8 at most, since each needs about 0.4 GB."""
    return min(8, default_workers())
