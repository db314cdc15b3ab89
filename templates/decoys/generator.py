"""Decoys that belong to nobody, spread like real embeddings, and the axes they are drawn along.

The generator holds moments, not embeddings, and is given to clients that lift on their own
(docs/rest.md "The generator"). The moments still tell who holds a photo whether that person was in
the fit, better than chance. Every draw is fresh, so no decoy exists outside its one template. It
does not depend on the subject (docs/method.md "The decoys").
"""

import hashlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from templates.decoys import container
from templates.decoys.fitting import Moments, adapted_moments, fit_moments
from templates.decoys.source import MAX_DIMENSION, Attributes, checked_made_with
from templates.errors import DecoyError, InvalidEmbedding
from templates.keys.randomness import Keystream
from templates.space.embedding import unit_descriptors

GENERATOR_FORMAT = "veilface decoy generator"
GENERATOR_VERSION = 2
MAX_GENERATOR_BYTES = 4 * MAX_DIMENSION * (2 * MAX_DIMENSION + 1) + container.MAX_HEADER + 8
_PARTS = ("axes", "mean", "root")
_CHUNK = 2048
"""Decoys made at once: bounds the float64 scratch memory at some 20 MB for n = 512."""
_SMALLEST_NORM = 1e-4
_LARGEST = 1e3
_ORTHONORMAL = 1e-3
# Decoys in a small subspace leave the hidden embedding the only direction outside it. Fits of real
# faces measure 0.52 k and more; so k / 8 refuses no real fit.
_SMALLEST_SHARE = 1 / 8
_CHECKED_FROM = 64
_FLOOR = 1e-9


class DecoyGenerator:
    """Draws embeddings of nobody from a Gaussian, in the coordinates of leading axes of faces.

    Embeddings have n numbers. What is lifted, stored and compared are their coordinates along k
    axes, scaled to length 1 (:meth:`project`): the axes of least variance tell people apart hardly
    at all, and are where decoys fit worst.

    Parameters
    ----------
    axes
        Shape (n, k). Orthonormal columns, of the largest variance of faces first.
    mean
        Shape (k,). Mean of the coordinates of faces.
    root
        Shape (k, k). Lower Cholesky factor of their covariance.
    made_with
        `templates.contract.binding.embedding_id` of the pack that gave the embeddings of the fit.

    Raises
    ------
    DecoyError
        Shapes that do not fit, values that are not finite or out of range, axes that are not
        orthonormal, `made_with` that is not 64 lower-case hexadecimal digits, or, from 64 axes on,
        deviations on so few axes that the decoys hide nothing.

    Notes
    -----
    A decoy is x / ‖x‖ with x = mean + root · z and z standard normal. Its parameters are float32,
    read-only.
    """

    def __init__(
        self,
        axes: NDArray[np.floating],
        mean: NDArray[np.floating],
        root: NDArray[np.floating],
        *,
        made_with: str | None = None,
    ) -> None:
        self.axes, self.mean, self.root = (_frozen(part) for part in (axes, mean, root))
        self._check()
        self.n, self.k = self.axes.shape
        self.made_with = checked_made_with(made_with)
        self.source_id: str = hashlib.sha256(self.to_bytes()).hexdigest()

    def __repr__(self) -> str:
        return f"DecoyGenerator(n={self.n}, k={self.k}, id {self.source_id[:12]})"

    @classmethod
    def fit(cls, descriptors: NDArray[np.floating], *, made_with: str | None = None) -> Self:
        """Fit to real embeddings: float32, shape (N, n), unit rows, N ≥ 100; thousands are good.

        Of all n axes; :meth:`reduced` takes the leading ones. The same for the same embeddings on
        one machine; another processor or number of threads rounds differently, and so gives
        another `source_id`. A DecoyError for what :func:`fit_moments` cannot take.
        """
        return cls._of(fit_moments(descriptors), made_with)

    @classmethod
    def adapt(
        cls,
        descriptors: NDArray[np.floating],
        like: NDArray[np.floating],
        people: Sequence[str],
        *,
        made_with: str | None = None,
    ) -> Self:
        """Fit to many embeddings of any kind, adapted to few of the kind that is enrolled.

        Parameters are those of :func:`adapted_moments`; the people of ``like`` are never enrolled.
        """
        return cls._of(adapted_moments(descriptors, like, people), made_with)

    @classmethod
    def _of(cls, moments: Moments, made_with: str | None) -> Self:
        variances = np.diag(moments.covariance)
        floor = _FLOOR * variances.max() * np.eye(len(variances))
        root = np.linalg.cholesky(moments.covariance + floor)
        return cls(moments.axes, moments.mean, root, made_with=made_with)

    def in_coordinates_of_embeddings(self) -> Self:
        """The same decoys with the unit axes: nothing is projected (k = n)."""
        axes = self.axes.astype(np.float64)
        if self.k != self.n:
            raise DecoyError("a generator of fewer axes has no form without them")
        turned = axes @ self.root
        root = np.asarray(np.linalg.qr(turned.T, mode="r")).T
        root = root * np.sign(np.diag(root))
        return type(self)(np.eye(self.n), axes @ self.mean, np.tril(root), made_with=self.made_with)

    def reduced(self, k: int) -> Self:
        """The generator of the leading ``k`` axes, 2 or more; itself where it has no more."""
        if not 2 <= k <= self.k:
            raise DecoyError(f"the decoys have {self.k} axes; {k} were asked for")
        if k == self.k:
            return self
        return type(self)(
            self.axes[:, :k], self.mean[:k], self.root[:k, :k], made_with=self.made_with
        )

    def axes_for(self, share: float) -> int:
        """Number of leading axes that hold this share of the decoys' variance, at least 2."""
        variances = np.sum(self.root.astype(np.float64) ** 2, axis=1)
        shares = np.cumsum(variances) / variances.sum()
        return int(np.clip(np.searchsorted(shares, share) + 1, 2, self.k))

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Covariance (k, k) of what is drawn, before it is scaled to length 1."""
        root = self.root.astype(np.float64)
        return np.asarray(root @ root.T)

    @property
    def second_moment(self) -> NDArray[np.float64]:
        """Second moment (k, k) about the origin of what is drawn, before it is scaled."""
        mean = self.mean.astype(np.float64)
        return self.covariance + np.outer(mean, mean)

    @cached_property
    def _wide_axes(self) -> NDArray[np.float64]:
        """The axes in the precision of a projection, made once: every decision projects."""
        return self.axes.astype(np.float64)

    def project(self, descriptors: ArrayLike) -> NDArray[np.float32]:
        """Take embeddings to the coordinates that templates have.

        Parameters
        ----------
        descriptors : array_like, shape (N, n)
            Unit rows.

        Returns
        -------
        float32, shape (N, k)
            Unit rows.

        Raises
        ------
        InvalidEmbedding
            A row is no finite unit vector, or has no part along the axes.
        """
        points = unit_descriptors(descriptors)
        if points.shape[1] != self.n:
            raise InvalidEmbedding(f"an embedding has {self.n} numbers, not {points.shape[1]}")
        along = points @ self._wide_axes
        norms = np.linalg.norm(along, axis=1, keepdims=True)
        if not (norms > _SMALLEST_NORM).all():
            raise InvalidEmbedding(
                "the embedding has no part along the axes of faces: send what the contract's model "
                "gives for a face"
            )
        return np.asarray(along / norms, dtype=np.float32)

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

        A DecoyError where `unlike` or `sub_databases` is asked for: both are choices among labelled
        real embeddings, and choosing by the subject's attributes would leak them (docs/method.md).
        """
        if unlike is not None:
            raise DecoyError(
                "a decoy generator draws independently of the subject's attributes; hybrid+ "
                "needs a labelled decoy pool"
            )
        if sub_databases is not None:
            raise DecoyError("a decoy generator has no sub-databases; use a decoy pool")
        mean, root = self.mean.astype(np.float64), self.root.astype(np.float64)
        decoys = np.empty((rows * k, self.k), dtype=np.float32)
        for start in range(0, len(decoys), _CHUNK):
            stop = min(start + _CHUNK, len(decoys))
            x = mean + stream.normal((stop - start, self.k)) @ root.T
            norms = np.linalg.norm(x, axis=1, keepdims=True)
            if not (norms > _SMALLEST_NORM).all() or not np.isfinite(norms).all():
                raise DecoyError("the decoy generator makes vectors without a direction")
            decoys[start:stop] = x / norms
        return decoys.reshape(rows, k, self.k)

    def to_bytes(self) -> bytes:
        """Serialise; equal generators give equal bytes, and `source_id` is their SHA-256."""
        fields: dict[str, str | int] = {"format": GENERATOR_FORMAT, "version": GENERATOR_VERSION}
        if self.made_with is not None:
            fields["made_with"] = self.made_with
        return container.encode(fields, {name: getattr(self, name) for name in _PARTS})

    @classmethod
    def from_bytes(cls, data: bytes) -> Self:
        """Read what `to_bytes` wrote; `data` may be hostile: anything else is a DecoyError."""
        fields, arrays = container.decode(
            data, what="decoy generator", max_bytes=MAX_GENERATOR_BYTES
        )
        if (fields.get("format"), fields.get("version")) != (GENERATOR_FORMAT, GENERATOR_VERSION):
            raise DecoyError(
                f"this is not a decoy generator of version {GENERATOR_VERSION}: build it with "
                "`veilface decoys build`"
            )
        if set(arrays) != set(_PARTS):
            raise DecoyError("the decoy generator has missing or unknown parts")
        if any(part.dtype != np.float32 for part in arrays.values()):
            raise DecoyError("the decoy generator holds numbers that are not float32")
        made = cls(**arrays, made_with=fields.get("made_with"))  # type: ignore[arg-type]
        if made.to_bytes() != data:
            raise DecoyError("the decoy generator is not in its canonical encoding")
        return made

    def save(self, path: Path) -> None:
        """Write the generator as a plain file, which clients may have."""
        container.write_private(path, self.to_bytes())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote."""
        return cls.from_bytes(container.read_bounded(path, MAX_GENERATOR_BYTES))

    def _check(self) -> None:
        n, k = self.axes.shape if self.axes.ndim == 2 else (0, 0)
        if not 2 <= k <= n <= MAX_DIMENSION:
            raise DecoyError(
                f"a decoy generator has 2 to {MAX_DIMENSION} numbers and at most as many axes; "
                f"seen axes of shape {self.axes.shape}"
            )
        if self.mean.shape != (k,) or self.root.shape != (k, k):
            raise DecoyError(
                f"{k} axes need a mean of shape ({k},) and a root of shape ({k}, {k}); seen "
                f"{self.mean.shape} and {self.root.shape}"
            )
        if not all(np.isfinite(part).all() for part in (self.axes, self.mean, self.root)):
            raise DecoyError("the decoy generator holds values that are not finite")
        if max(float(np.abs(self.mean).max()), float(np.abs(self.root).max())) > _LARGEST:
            raise DecoyError("the decoy generator holds values far from those of unit embeddings")
        if np.triu(self.root, 1).any() or float(np.diag(self.root).min()) <= 0:
            raise DecoyError("the root of the decoy generator is no lower Cholesky factor")
        products = self.axes.T.astype(np.float64) @ self.axes
        if float(np.abs(products - np.eye(k)).max()) > _ORTHONORMAL:
            raise DecoyError("the axes of the decoy generator are not orthonormal")
        # The sum of the deviations along principal axes is at least the trace of any root.
        root = self.root.astype(np.float64)
        spread = float(np.trace(root)) ** 2 / float(np.sum(root**2))
        if k >= _CHECKED_FROM and spread < _SMALLEST_SHARE * k:
            raise DecoyError(
                f"the decoys would spread over {spread:.0f} of {k} axes, and would hide nothing; "
                f"at least {_SMALLEST_SHARE * k:.0f} are needed"
            )


def _frozen(part: NDArray[np.floating]) -> NDArray[np.float32]:
    array = np.array(part, dtype="<f4", order="C", copy=True)
    array.flags.writeable = False
    return array
