"""Aligned faces, for the decoder that draws faces from embeddings."""

import numpy as np
from numpy.typing import NDArray

from models.decoding import decode_image
from models.extraction import Extraction
from models.pack import ModelPack


class FaceCrops:
    """Crops of embedded photos, of the embedder's size."""

    def __init__(self, pack: ModelPack, faces: Extraction, *, aligned: bool) -> None:
        self._pack = pack
        self._faces = faces
        self._aligned = aligned

    def of(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Crops of some rows of the faces, uint8 (B, s, s, 3)."""
        crops = []
        for row in rows.tolist():
            image = decode_image(self._faces.paths[row].read_bytes())
            if self._aligned:
                crops.append(self._pack.as_aligned(image))
            else:
                crops.append(self._pack.align(image, self._pack.detect(image)[0]))
        return np.stack(crops)

    def embed(self, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Embed crops as the service would."""
        return self._pack.embed(crops)
