"""Decoys that belong to nobody: a distribution fitted to real descriptors.

The generator holds statistics, not people: it may be given to clients that lift on their own
(PRODUCT "Contract"). Every draw is fresh, so no decoy exists outside its one template, and it
does not depend on the subject (METHOD §4.2 to §4.5).
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from templates.decoys import container
from templates.decoys.files import read_bounded, write_private
from templates.decoys.source import MAX_DIMENSION, Attributes
from templates.errors import DecoyError
from templates.randomness import Keystream

GENERATOR_FORMAT = "veilface decoy generator"
GENERATOR_VERSION = 1
MAX_GENERATOR_BYTES = MAX_DIMENSION * (MAX_DIMENSION + 1) * 4 + container.MAX_HEADER + 8
MIN_SAMPLES = 100
_CHUNK = 4096
"""Decoys drawn at once: bounds the float64 scratch memory at 16 MB for n = 512."""


class DecoyGenerator:
    """A Gaussian with the full covariance of real descriptors, its samples normalised.

    Parameters
    ----------
    mean
        float32, shape (n,).
    factor
        float32, shape (n, n): a sample is ``mean + z @ factor`` with standard normal z, so
        ``factor.T @ factor`` is the covariance.

    Raises
    ------
    DecoyError
        Wrong shapes or values that are not finite.

    References
    ----------
    METHOD §3 (Gaussian decoys) and §4.5 (drawn independently of the subject's attributes).
    """

    def __init__(self, mean: NDArray[np.floating], factor: NDArray[np.floating]) -> None:
        self._mean = np.array(mean, dtype="<f4", order="C", copy=True)
        self._factor = np.array(factor, dtype="<f4", order="C", copy=True)
        n = self._mean.shape[0] if self._mean.ndim == 1 else 0
        if not 2 <= n <= MAX_DIMENSION or self._factor.shape != (n, n):
            raise DecoyError(
                "a decoy generator needs a mean of shape (n,) and a factor of shape (n, n); "
                f"seen {self._mean.shape} and {self._factor.shape}"
            )
        if not (np.isfinite(self._mean).all() and np.isfinite(self._factor).all()):
            raise DecoyError("the decoy generator holds values that are not finite")
        # Beyond these bounds a sample overflows or collapses to zero before it is normalised.
        scale = float(np.abs(self._factor).max())
        if not 1e-6 <= scale <= 1e3 or float(np.abs(self._mean).max()) > 1e3:
            raise DecoyError("the decoy generator holds values far from those of unit descriptors")
        self.n: int = n
        self.source_id: str = hashlib.sha256(self.to_bytes()).hexdigest()

    def __repr__(self) -> str:
        return f"DecoyGenerator(n={self.n}, id {self.source_id[:12]})"

    @classmethod
    def fit(cls, descriptors: NDArray[np.floating]) -> Self:
        """Fit to real descriptors.

        Parameters
        ----------
        descriptors
            float32, shape (N, n), unit rows, N ≥ 100.

        Raises
        ------
        DecoyError
            Too few descriptors, or descriptors that are not finite unit vectors.
        """
        x = np.asarray(descriptors, dtype=np.float64)
        if x.ndim != 2 or x.shape[0] < MIN_SAMPLES:
            raise DecoyError(
                f"a decoy generator needs at least {MIN_SAMPLES} descriptors of shape (N, n); "
                f"seen {x.shape}"
            )
        if not np.all(np.abs(np.linalg.norm(x, axis=1) - 1.0) <= 1e-3):
            raise DecoyError("the descriptors to fit are not all finite unit vectors")
        mean = x.mean(axis=0)
        values, vectors = np.linalg.eigh(np.cov(x, rowvar=False))
        factor = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
        return cls(mean, factor)

    def draw(
        self,
        rows: int,
        k: int,
        *,
        stream: Keystream,
        unlike: Sequence[Attributes] | None = None,
        sub_databases: int | None = None,
    ) -> NDArray[np.float32]:
        """Draw fresh decoys; see `DecoySource.draw`.

        Raises
        ------
        DecoyError
            `unlike` or `sub_databases` is asked for: both are choices among labelled real
            descriptors, and choosing by the subject's attributes would leak them (METHOD §4.5).
        """
        if rows < 0 or k < 0:
            raise DecoyError(f"rows and k must not be negative; seen {rows} and {k}")
        if unlike is not None:
            raise DecoyError(
                "a decoy generator draws independently of the subject's attributes; hybrid+ "
                "needs a labelled decoy pool"
            )
        if sub_databases is not None:
            raise DecoyError("a decoy generator has no sub-databases; use a decoy pool")
        decoys = np.empty((rows * k, self.n), dtype=np.float32)
        mean, factor = self._mean.astype(np.float64), self._factor.astype(np.float64)
        for start in range(0, len(decoys), _CHUNK):
            count = min(_CHUNK, len(decoys) - start)
            x = mean + stream.normal((count, self.n)) @ factor
            x /= np.linalg.norm(x, axis=1, keepdims=True)
            decoys[start : start + count] = x
        return decoys.reshape(rows, k, self.n)

    def to_bytes(self) -> bytes:
        """Serialise; equal generators give equal bytes, and `source_id` is their SHA-256."""
        fields: container.Fields = {"format": GENERATOR_FORMAT, "version": GENERATOR_VERSION}
        return container.encode(fields, {"factor": self._factor, "mean": self._mean})

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read what `to_bytes` wrote; `data` may be hostile.

        Raises
        ------
        DecoyError
            The bytes are not exactly what `to_bytes` writes for some generator.
        """
        fields, arrays = container.decode(
            data, what="decoy generator", max_bytes=MAX_GENERATOR_BYTES
        )
        if fields != {"format": GENERATOR_FORMAT, "version": GENERATOR_VERSION}:
            raise DecoyError(f"this is not a decoy generator of version {GENERATOR_VERSION}")
        if set(arrays) != {"factor", "mean"} or any(a.dtype != np.float32 for a in arrays.values()):
            raise DecoyError("the decoy generator has missing or unknown parts")
        return cls(arrays["mean"].astype(np.float32), arrays["factor"].astype(np.float32))

    def save(self, path: Path) -> None:
        """Write the generator as a plain file: it holds nothing of any single person.

        Raises
        ------
        DecoyError
            The file cannot be written.
        """
        write_private(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        DecoyError
            The file cannot be read or is no decoy generator.
        """
        return cls.from_bytes(read_bounded(path, MAX_GENERATOR_BYTES))
