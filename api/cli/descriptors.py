"""Descriptors of many photos, with a progress bar and an account of the failures."""

from collections.abc import Sequence
from pathlib import Path

from api.cli.console import message, progress
from api.cli.errors import CommandError
from api.preparation import Acquisition
from models.extraction import Extraction, Extractor
from models.pack import ModelPack


def extract(
    pack: ModelPack, photos: Sequence[Path], *, aligned: bool, what: str
) -> tuple[Extraction, Acquisition]:
    """Embed photos; those that fail are counted, reported and left out.

    Raises
    ------
    CommandError
        No photo gave a descriptor.
    """
    with progress(what, len(photos)) as advance:
        extraction = Extractor(pack, aligned=aligned).extract(photos, progress=advance)
    acquired = Acquisition.of(extraction)
    if acquired.failed:
        message(f"note: {acquired}")
    if not len(extraction.descriptors):
        raise CommandError(
            f"no photo gave a descriptor: {acquired}; are these photos of faces, and does "
            "--aligned fit them?"
        )
    return extraction, acquired
