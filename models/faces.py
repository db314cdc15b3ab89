"""One face of a photo, before and after it is embedded."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.boxes import Face
from models.liveness import Box
from models.quality import Quality


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceCrop:
    """One face of a photo, before it is embedded; the photo itself is not kept.

    Attributes
    ----------
    crop
        Aligned, RGB uint8, shape (s, s, 3). Never shown by ``repr``.
    face
        As it was detected; ``None`` for crops that came aligned.
    liveness, picture
        As in `FaceSample`.
    """

    crop: NDArray[np.uint8] = field(repr=False)
    quality: Quality
    face: Face | None = field(repr=False)
    liveness: float | None = None
    picture: bytes | None = field(default=None, repr=False)

    @property
    def box(self) -> Box | None:
        """x1, y1, x2, y2 in pixels of the upright photo; ``None`` where nothing was detected."""
        if self.face is None:
            return None
        x1, y1, x2, y2 = (float(value) for value in self.face.box)
        return x1, y1, x2, y2


@dataclass(frozen=True, eq=False)
class FaceSample:
    """One face of a photo, embedded.

    Attributes
    ----------
    embedding
        float32, shape (n,), unit norm. Never shown by ``repr``.
    box
        x1, y1, x2, y2 in pixels of the upright photo; ``None`` for crops that came aligned.
    liveness
        How live the face looks (`PassiveLiveness.score`); ``None`` where it was not asked for.
    picture
        SHA-256 of the decoded photo; ``None`` where it was not asked for. Never shown by ``repr``.
    """

    embedding: NDArray[np.float32] = field(repr=False)
    quality: Quality
    box: Box | None
    liveness: float | None = None
    picture: bytes | None = field(default=None, repr=False)
