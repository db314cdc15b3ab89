"""Several photos of one person, each to the embedding of its face."""

from collections.abc import Sequence
from typing import Unpack

from models.errors import ModelError, PhotoRejected
from models.faces import FaceSample
from models.pack import ModelPack, PhotoOptions


def embed_photos(
    pack: ModelPack, photos: Sequence[bytes], **options: Unpack[PhotoOptions]
) -> list[FaceSample]:
    """Embed photo files in their order; all or none. A file given twice is embedded once.

    Raises
    ------
    PhotoRejected
        Where one of them has no usable face, by its position.
    """
    samples: dict[bytes, FaceSample] = {}
    for index, photo in enumerate(photos):
        if photo in samples:
            continue
        try:
            samples[photo] = pack.embed_photo(photo, **options)
        except ModelError as error:
            raise PhotoRejected(index, error, count=len(photos)) from error
    return [samples[photo] for photo in photos]
