"""Embeddings of many photos, with a progress bar and an account of the failures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import message, progress
from api.cli.errors import CommandError, UsageError
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from models.cache import EmbeddingCache
from models.extraction import Extraction, Extractor
from models.pack import ModelPack
from models.sessions import default_workers
from verify.preparation import acquired, without_lookalikes

BULK = ("pack", "providers", "data_dir", "database_url", "master_key_file")

Aligned = Annotated[
    bool, typer.Option("--aligned", help="The photos are aligned square crops already.")
]
Flip = Annotated[
    bool,
    typer.Option(
        "--flip",
        help="Add the embedding of the mirrored face. Decoys and contract must agree on it.",
    ),
]
Cache = Annotated[
    Path | None,
    typer.Option(
        help="Keep embeddings in this file, sealed with the master key, so that the next run on "
        "the same photos is quick. Unset: they are not kept."
    ),
]


def bulk_pack(settings: Settings, *, flip: bool, why: str) -> ModelPack:
    """Load the pack with as many threads as there are processors."""
    if settings.pack is None:
        raise UsageError(f"{why}; name the pack with --pack")
    return ModelPack.load(
        settings.pack, providers=settings.providers, threads=default_workers(), flip=flip
    )


def open_cache(cache: Path | None, settings: Settings) -> EmbeddingCache | None:
    """Open the sealed cache of embeddings, where one is named; make the folder that it goes to."""
    if cache is None:
        return None
    cache.parent.mkdir(parents=True, exist_ok=True)
    return EmbeddingCache.open_file(cache, file_sealer(open_keyring(settings)))


def extract(
    pack: ModelPack,
    photos: Sequence[Path],
    *,
    aligned: bool,
    settings: Settings,
    cache: Path | None,
) -> Extraction:
    """Embed photos; those that fail are counted, reported and left out."""
    kept = open_cache(cache, settings)
    extractor = Extractor(pack, aligned=aligned, cache=kept)
    with progress("embedding faces", len(photos)) as advance:
        extraction = extractor.extract(photos, progress=advance)
    if kept is not None:
        kept.flush()
    if not extraction.paths:
        raise CommandError(
            f"no photo gave an embedding ({acquired(extraction)}); are these photos of faces, and "
            "is --aligned right for them?"
        )
    if extraction.failures:
        message(f"note: {acquired(extraction)}")
    return extraction


def each_person_once(extraction: Extraction) -> Extraction:
    """Leave out photos that look like an earlier one, and say how many, where nobody is named."""
    kept = without_lookalikes(extraction)
    total, left = len(extraction.paths), len(kept.paths)
    if left < total:
        message(f"note: {total - left} of {total} photos look like another one, and are left out")
    return kept
