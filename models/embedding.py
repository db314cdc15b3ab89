"""Aligned crops → unit embeddings, by an ArcFace-like graph."""

from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from models.errors import ModelError
from models.pack_file import Triple
from models.sessions import Session

# Activations of one batch are alive at once. Those of 8 crops stay in the cache: a crop costs less
# of the processor than in batches of 32 (docs/models.md has the measurement).
MAX_BATCH = 8
# Counts the ways from a photo to its crop. 2: the letterbox and the two canvases of
# `models.detection`; 1, without a number in the contract, was one canvas, its sides rounded.
PREPROCESSING_VERSION = 2
# Share of the differences between pictures below which normalised values tell a graph too little.
_TELLS_LITTLE = 0.2

Rows = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Preprocessing:
    """What happens to a crop before the graph sees it: ``(x - mean) / scale`` per channel.

    Part of the contract: embeddings of different preprocessing are not comparable.
    """

    alignment: str
    size: int
    channel_order: str
    mean: Triple
    scale: Triple
    flip: bool

    def as_dict(self) -> dict[str, Any]:
        """JSON-able form, the one that contracts bind to."""
        numbers = {"mean": list(self.mean), "scale": list(self.scale)}
        return {"version": PREPROCESSING_VERSION, **asdict(self), **numbers}


class Embedder:
    """An embedding graph, one image in and one row (batch, n) out, with its preprocessing."""

    def __init__(self, session: Session, preprocessing: Preprocessing) -> None:
        self._session = session
        self.preprocessing = preprocessing
        self._order = [2, 1, 0] if preprocessing.channel_order == "bgr" else [0, 1, 2]
        self._mean = np.asarray(preprocessing.mean, dtype=np.float32)
        self._inverse_scale = (1 / np.asarray(preprocessing.scale)).astype(np.float32)
        self.n = self._normalised(self._raw(_noise(preprocessing.size)[:1])).shape[1]

    def embed(self, crops: NDArray[np.uint8], *, flip: bool) -> Rows:
        """Embed aligned crops."""
        raw = self._raw(crops)
        return self._normalised(raw + self._raw(crops[:, :, ::-1]) if flip else raw)

    def _raw(self, crops: NDArray[np.uint8]) -> Rows:
        size = self.preprocessing.size
        if crops.dtype != np.uint8 or crops.ndim != 4 or crops.shape[1:] != (size, size, 3):
            raise ModelError(
                f"Aligned crops must be uint8 of shape (B, {size}, {size}, 3); got {crops.dtype}"
                f" of shape {crops.shape}."
            )
        values = crops[..., self._order].astype(np.float32)
        return run_embedder(self._session, (values - self._mean) * self._inverse_scale)

    def _normalised(self, raw: Rows) -> Rows:
        # float64: squares of large activations overflow float32.
        norms = np.linalg.norm(raw.astype(np.float64), axis=1, keepdims=True)
        if not np.isfinite(norms).all() or (norms == 0).any():
            raise ModelError(
                f"{self._session.name}: the output for a crop is zero or not finite; the weights"
                " do not fit this preprocessing, or are damaged."
            )
        return np.ascontiguousarray(raw / norms, dtype=np.float32)


def run_embedder(session: Session, values: NDArray[np.float32]) -> Rows:
    """Run an embedding graph on pictures of one size, (B, s, s, 3), in its channel order."""
    image = session.inputs[0]
    step = image.shape[0] or MAX_BATCH
    rows = []
    for start in range(0, len(values), step):
        part = values[start : start + step].transpose(0, 3, 1, 2)
        # A graph with a fixed batch gets its last one filled up with zeros.
        missing = step - len(part) if image.shape[0] else 0
        blob = np.pad(part, ((0, missing), (0, 0), (0, 0), (0, 0)))
        row = session.run({image.name: np.ascontiguousarray(blob)})[0]
        if row.ndim != 2 or len(row) != len(blob):
            raise ModelError(
                f"{session.name}: {len(blob)} crops gave an output of shape {row.shape}."
            )
        rows.append(row[: len(part)])
    return np.concatenate(rows)


def normalises_inside(session: Session, size: int) -> bool:
    """Whether an embedding graph brings its own normalisation, so that it wants pixels, 0...255.

    Such a graph sees values from -1 to 1 as almost one colour, and tells pictures apart far worse
    by them than by their pixels. Of the embedders that were measured, one that normalises inside
    keeps 0.02 of the differences, and the others keep 0.9 and more (docs/models.md).
    """
    pixels = _noise(size).astype(np.float32)

    def differences(pictures: NDArray[np.float32]) -> float:
        rows = run_embedder(session, pictures).astype(np.float64)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        return float(1 - np.square(rows.mean(axis=0)).sum())

    with np.errstate(invalid="ignore"):
        return differences((pixels - 127.5) / 127.5) < _TELLS_LITTLE * differences(pixels)


def _noise(size: int) -> NDArray[np.uint8]:
    """Four pictures of smooth noise, (4, size, size, 3)."""
    cells = np.random.default_rng(0).integers(0, 256, (4, 14, 14, 3), dtype=np.uint8)
    smooth = [cv2.resize(part, (size, size), interpolation=cv2.INTER_CUBIC) for part in cells]
    return np.stack(smooth).astype(np.uint8)
