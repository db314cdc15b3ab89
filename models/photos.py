"""Several photos of one person, each to the embedding of its face."""

from collections.abc import Sequence

from models.decoding import DEFAULT_LIMITS, ImageLimits
from models.errors import ModelError, PhotoRejected
from models.faces import FaceSample
from models.pack import ModelPack
from models.quality import DEFAULT_QUALITY, QualityLimits
from models.selection import FacePolicy


def embed_photos(
    pack: ModelPack,
    photos: Sequence[bytes],
    *,
    policy: FacePolicy = FacePolicy.DOMINANT,
    quality: QualityLimits | None = DEFAULT_QUALITY,
    limits: ImageLimits = DEFAULT_LIMITS,
    liveness: bool = False,
    digested: bool = False,
) -> list[FaceSample]:
    """Embed photo files in their order; all or none. A file given twice is embedded once.

    Parameters
    ----------
    policy, quality, limits, liveness, digested
        See ``ModelPack.embed_photo``.

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
            samples[photo] = pack.embed_photo(
                photo,
                policy=policy,
                quality=quality,
                limits=limits,
                liveness=liveness,
                digested=digested,
            )
        except ModelError as error:
            raise PhotoRejected(index, error, count=len(photos)) from error
    return [samples[photo] for photo in photos]
