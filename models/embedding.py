"""Aligned crops → unit embeddings, by an ArcFace-like graph."""

from dataclasses import dataclass
from typing import Any

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
        return {
            "version": PREPROCESSING_VERSION,
            "alignment": self.alignment,
            "size": self.size,
            "channel_order": self.channel_order,
            "mean": list(self.mean),
            "scale": list(self.scale),
            "flip": self.flip,
        }


class Embedder:
    """An embedding graph with its preprocessing.

    Parameters
    ----------
    session
        A graph with one image input and one output (batch, n).
    batch
        The batch size where the graph accepts no other; ``None`` where any will do.
    """

    def __init__(
        self, session: Session, *, input_name: str, preprocessing: Preprocessing, batch: int | None
    ) -> None:
        self._session = session
        self._input_name = input_name
        self._batch = batch
        self.preprocessing = preprocessing
        order = [2, 1, 0] if preprocessing.channel_order == "bgr" else [0, 1, 2]
        self._order = order
        self._mean = np.asarray(preprocessing.mean, dtype=np.float32)
        self._inverse_scale = (1 / np.asarray(preprocessing.scale)).astype(np.float32)
        self.n = self._dimension()

    def embed(self, crops: NDArray[np.uint8], *, flip: bool) -> NDArray[np.float32]:
        """Embed aligned crops.

        Parameters
        ----------
        crops
            RGB uint8, shape (B, s, s, 3) with the size of the preprocessing.
        flip
            Whether the raw embedding of the mirrored crop is added before normalising.

        Returns
        -------
        ndarray of float32, shape (B, n)
            Unit L2 norm per row, C-contiguous.

        Raises
        ------
        ModelError
            If the crops have another shape or type, or an output is zero or not finite.
        """
        self._check(crops)
        raw = np.empty((len(crops), self.n), dtype=np.float32)
        for start in range(0, len(crops), MAX_BATCH):
            part = crops[start : start + MAX_BATCH]
            raw[start : start + MAX_BATCH] = self._raw(part)
            if flip:
                raw[start : start + MAX_BATCH] += self._raw(part[:, :, ::-1])
        return self._normalised(raw)

    def embed_both(
        self, crops: NDArray[np.uint8]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Embed aligned crops without and with the mirror image, at the cost of the latter.

        Parameters and errors as in :meth:`embed`.

        Returns
        -------
        two ndarrays of float32, shape (B, n)
        """
        self._check(crops)
        plain = np.empty((len(crops), self.n), dtype=np.float32)
        both = np.empty_like(plain)
        for start in range(0, len(crops), MAX_BATCH):
            rows = slice(start, start + MAX_BATCH)
            plain[rows] = self._raw(crops[rows])
            both[rows] = plain[rows] + self._raw(crops[rows][:, :, ::-1])
        return self._normalised(plain), self._normalised(both)

    def _check(self, crops: NDArray[np.uint8]) -> None:
        size = self.preprocessing.size
        if crops.dtype != np.uint8 or crops.ndim != 4 or crops.shape[1:] != (size, size, 3):
            raise ModelError(
                f"Aligned crops must be uint8 of shape (B, {size}, {size}, 3); got {crops.dtype}"
                f" of shape {crops.shape}."
            )

    def _normalised(self, raw: NDArray[np.float32]) -> NDArray[np.float32]:
        # float64: squares of large activations overflow float32.
        norms = np.linalg.norm(raw.astype(np.float64), axis=1, keepdims=True)
        if not np.isfinite(norms).all() or (norms == 0).any():
            raise ModelError(
                f"{self._session.name}: the output for a crop is zero or not finite; the weights"
                " do not fit this preprocessing, or are damaged."
            )
        return np.ascontiguousarray(raw / norms, dtype=np.float32)

    def _raw(self, crops: NDArray[np.uint8]) -> NDArray[np.float32]:
        normalised = (crops[..., self._order].astype(np.float32) - self._mean) * self._inverse_scale
        blob = np.ascontiguousarray(normalised.transpose(0, 3, 1, 2))
        step = self._batch or len(blob)
        rows = []
        for start in range(0, len(blob), step):
            part = blob[start : start + step]
            # A graph with a fixed batch gets its last one filled up with zeros.
            missing = step - len(part)
            fed = np.pad(part, ((0, missing), (0, 0), (0, 0), (0, 0))) if missing else part
            rows.append(self._session.run({self._input_name: fed})[0][: len(part)])
        return np.concatenate(rows)

    def _dimension(self) -> int:
        """Run once on a noise picture: proves that the graph runs, and tells n."""
        size = self.preprocessing.size
        noise = np.random.default_rng(0).integers(0, 256, (1, size, size, 3), dtype=np.uint8)
        output = self._raw(noise)
        if output.ndim != 2 or output.shape[0] != 1 or not np.isfinite(output).all():
            raise ModelError(
                f"{self._session.name}: one crop must give one row of finite numbers; got shape"
                f" {output.shape}."
            )
        return int(output.shape[1])
