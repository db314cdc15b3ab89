"""One face of a photo, before and after it is embedded."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from models.boxes import Face
from models.liveness import Box
from models.quality import Quality


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceCrop:
    """One face of a photo; the photo itself is not kept, and ``repr`` shows no pixel."""

    crop: NDArray[np.uint8] = field(repr=False)  # aligned, RGB, (s, s, 3)
    quality: Quality
    face: Face | None = field(repr=False)  # as it was detected; None where it came aligned
    # How live it looks, and the SHA-256 of the decoded photo; None where it was not asked for.
    liveness: float | None = None
    picture: bytes | None = field(default=None, repr=False)

    @property
    def box(self) -> Box | None:
        """x1, y1, x2, y2 in pixels of the upright photo; ``None`` where nothing was detected."""
        if self.face is None:
            return None
        x1, y1, x2, y2 = (float(value) for value in self.face.box)
        return x1, y1, x2, y2


@dataclass(frozen=True, eq=False, kw_only=True)
class FaceSample(FaceCrop):
    """One face of a photo with its embedding, float32, shape (n,), unit norm."""

    embedding: NDArray[np.float32] = field(repr=False)
