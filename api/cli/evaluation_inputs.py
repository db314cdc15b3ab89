"""What ``veilface evaluate`` works on: sets, the embedder and decoys."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

from api.cli.bulk import Bulk
from api.cli.errors import CommandError, UsageError
from templates.decoys import DecoyGenerator, DecoyPool, load_source
from templates.decoys.pool import POOL_MAGIC
from verify.evaluation.embedding import Embedder, FileEmbedder, PackEmbedder
from verify.evaluation.embeddings_file import read_embeddings
from verify.evaluation.plan import Source
from verify.evaluation.readers import open_sets
from verify.evaluation.sources import SourceFacts
from verify.evaluation.verification_set import VerificationSet
from verify.preparation import recorded_of, require_made_with


def open_all(datasets: Sequence[Path], *, pictures: bool) -> list[VerificationSet]:
    """Open the sets, whose names must differ."""
    sets = [pairs for path in datasets for pairs in open_sets(path, pictures=pictures)]
    names = [pairs.name for pairs in sets]
    if len(set(names)) < len(names):
        raise UsageError(
            f"two sets have one name ({', '.join(sorted(names))}), and rows are told apart by it: "
            "evaluate them one at a time, or rename a file"
        )
    return sets


def open_embedder(bulk: Bulk, embeddings: Path | None, *, aligned: bool | None) -> Embedder:
    """Open the pack, or the file of embeddings."""
    has_pack = bulk.settings.pack is not None and str(bulk.settings.pack) != "none"
    if has_pack == (embeddings is not None):
        raise UsageError("give a pack, or `--pack none --embeddings FILE`: the one or the other")
    if embeddings is None:
        return PackEmbedder(bulk.pack, recorded_of(bulk.pack), aligned=aligned)
    if bulk.flip:
        raise UsageError("--flip needs a pack: embeddings in a file are as they are")
    return FileEmbedder(read_embeddings(embeddings), embeddings.name)


def open_sources(
    files: Sequence[Path], bulk: Bulk, embedder: Embedder, *, axes: int | None
) -> list[SourceFacts]:
    """Load decoy files, reduce generators to so many axes, and check that they fit."""
    sources = []
    for file in files:
        with file.open("rb") as stream:
            is_pool = stream.read(len(POOL_MAGIC)) == POOL_MAGIC
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        # A generator is not sealed, and needs no key.
        source: Source = load_source(file, bulk.sealer) if is_pool else DecoyGenerator.load(file)
        if axes is not None and not is_pool:
            source = source.reduced(axes)
        if isinstance(embedder, PackEmbedder):
            require_made_with(source, embedder.pack)
        elif source.n != embedder.model["n"]:
            raise CommandError(
                f"{file.name} has decoys of {source.n} numbers each, the embeddings have "
                f"{embedder.model['n']}; build the decoys with their pack"
            )
        sources.append(SourceFacts(source, file.name, digest))
    kinds = [isinstance(facts.source, DecoyPool) for facts in sources]
    if len(set(kinds)) != len(kinds):
        raise UsageError("give one pool and one generator at most: rows name the kind only")
    return sources
