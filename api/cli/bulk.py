"""Embeddings of many photos, and the decoys and contract that experiments use with them."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from api.cli.console import message, progress
from api.cli.errors import CommandError, UsageError
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from models.cache import EmbeddingCache
from models.extraction import Extraction, Extractor
from models.pack import ModelPack
from models.sessions import default_workers
from templates.contract.document import Contract
from templates.decoys import DecoySource, load_source
from templates.keys.private_file import replace_public
from templates.keys.sealing import Sealer
from verify.preparation import acquired, recorded_of, require_made_with, without_lookalikes

BULK = ("pack", "providers", "data_dir", "database_url", "master_key_file")

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Bulk:
    """What embeds many photos, and opens what a deployment's master key sealed."""

    settings: Settings
    aligned: bool = False
    flip: bool = False
    cache_file: Path | None = None

    @cached_property
    def pack(self) -> ModelPack:
        """The pack, with as many threads as there are processors."""
        if self.settings.pack is None:
            raise UsageError("embeddings come from a model pack; name the pack with --pack")
        return ModelPack.load(
            self.settings.pack,
            providers=self.settings.providers,
            threads=default_workers(),
            flip=self.flip,
        )

    @cached_property
    def sealer(self) -> Sealer:
        """Seals and opens files under the master key, which is made where there is none."""
        return file_sealer(open_keyring(self.settings))

    @cached_property
    def cache(self) -> EmbeddingCache | None:
        """The sealed cache of embeddings, where one is named."""
        if self.cache_file is None:
            return None
        self.cache_file.parent.mkdir(parents=True, exist_ok=True)
        return EmbeddingCache(self.cache_file, self.sealer)

    def extract(self, photos: Sequence[Path]) -> Extraction:
        """Embed photos; those that fail are counted, reported and left out."""
        extractor = Extractor(self.pack, aligned=self.aligned, cache=self.cache)
        with progress("embedding faces", len(photos)) as advance:
            extraction = extractor.extract(photos, progress=advance)
        if self.cache is not None:
            self.cache.flush()
        if not extraction.paths:
            raise CommandError(
                f"no photo gave an embedding ({acquired(extraction)}); are these photos of faces, "
                "and is --aligned right for them?"
            )
        if extraction.failures:
            message(f"note: {acquired(extraction)}")
        return extraction

    def decoys(self, file: Path | None) -> DecoySource:
        """Load decoys that were made with this pack: those named, or the deployment's."""
        pack = self.pack
        source = load_source(file or self.settings.resolved_decoys_file, self.sealer)
        require_made_with(source, pack)
        return source

    def served_contract(self, source: DecoySource) -> Contract | None:
        """Return the contract in ``data_dir``, where it lifts with this source."""
        path = self.settings.resolved_contract_file
        if not path.is_file():
            return None
        contract = Contract.load(path, self.sealer)
        binding = contract.binding
        fits = binding.axes <= source.k and (
            binding.decoy_source_id == source.reduced(binding.axes).source_id
        )
        return contract if fits else None

    @property
    def model(self) -> dict[str, Any]:
        """Which model gives the embeddings, as reports say it."""
        return {**recorded_of(self.pack), "embedder_sha256": self.pack.info.embedder_sha256}


def each_person_once(extraction: Extraction) -> Extraction:
    """Leave out photos that look like an earlier one, and say how many, where nobody is named."""
    kept = without_lookalikes(extraction)
    total, left = len(extraction.paths), len(kept.paths)
    if left < total:
        message(f"note: {total - left} of {total} photos look like another one, and are left out")
    return kept


def listed(text: str, kind: Callable[[str], T], option: str, *, expected: str) -> tuple[T, ...]:
    """Read a list with commas, each value once; ``expected`` is said of anything else."""
    try:
        values = [kind(part.strip()) for part in text.split(",") if part.strip()]
    except (ValueError, KeyError):
        values = []
    if not values:
        raise UsageError(f"{option} takes {expected}, not {text!r}")
    return tuple(dict.fromkeys(values))


def listed_numbers(
    text: str, option: str, *, least: int = 1, most: int = 10_000
) -> tuple[int, ...]:
    """Read whole numbers within bounds, each once."""
    expected = f"whole numbers from {least} to {most}, with commas"
    numbers = listed(text, int, option, expected=expected)
    if not all(least <= number <= most for number in numbers):
        raise UsageError(f"{option} takes {expected}, not {text!r}")
    return numbers


def write_document(
    document: Mapping[str, Any], out: Path, name: str, *, markdown: str
) -> list[Path]:
    """Write what an experiment measured as ``name.json`` and ``name.md``; return the files."""
    out.mkdir(parents=True, exist_ok=True)
    files = [out / f"{name}.json", out / f"{name}.md"]
    text = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    replace_public(files[0], text.encode())
    replace_public(files[1], markdown.encode())
    return files
