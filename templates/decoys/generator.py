"""Decoys that belong to nobody, spread like real descriptors.

The generator holds moments, not descriptors, and is given to clients that lift on their own
(docs/rest.md "The generator"). The moments still tell who holds a photo whether that person was in
the fit, better than chance (docs/design-measurements.md "Whether it remembers people"). Every draw
is fresh, so no decoy exists outside its one template, and it does not depend on the subject
(docs/method.md §4.2 to §4.5). docs/design-measurements.md says how it was chosen.
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from templates.decoys import container
from templates.decoys.adaptation import adapted_statistics
from templates.decoys.files import read_bounded, write_private
from templates.decoys.fitting import fit_statistics
from templates.decoys.source import (
    MAX_DIMENSION,
    Attributes,
    checked_made_with,
    checked_noise,
    take_made_with,
)
from templates.decoys.statistics import (
    MAX_COMPONENTS,
    DescriptorStatistics,
    band_edges,
    feature_count,
    leading_axes,
)
from templates.errors import DecoyError
from templates.keys.randomness import Keystream

GENERATOR_FORMAT = "veilface decoy generator"
GENERATOR_VERSION = 1
_Q = feature_count(MAX_DIMENSION)
MAX_GENERATOR_BYTES = (
    4 * (MAX_DIMENSION * (MAX_DIMENSION + 1) + MAX_COMPONENTS * (1 + _Q + _Q * _Q))
    + container.MAX_HEADER
    + 8
)
_PARTS = ("mean", "axes", "weights", "centres", "spreads")
_CHUNK = 2048
"""Decoys made at once: bounds the float64 scratch memory at some 20 MB for n = 512."""
_SMALLEST_NORM = 1e-4


class DecoyGenerator:
    """Draws descriptors of nobody from the statistics of real descriptors.

    Parameters
    ----------
    statistics
        As `fit` finds them.
    made_with
        `templates.contract.binding.embedding_id` of the pack that gave the descriptors of the fit.
    noise
        Variance of the noise that every number of a decoy gets, and of a lifted descriptor.

    Raises
    ------
    DecoyError
        `made_with` is not 64 lower-case hexadecimal digits, or `noise` is out of range.

    Notes
    -----
    A decoy is x / ‖x‖ with x = mean + z · axes + e, and e the noise. A component of the Gaussian
    mixture is chosen, and gives the leading coordinates of z and the log energy of each band;
    inside a band z has a uniform direction and that energy. See `templates.decoys.statistics` for
    why.

    References
    ----------
    docs/method.md §4.5: independence of the subject's attributes; docs/design-measurements.md
    §1.3: a Gaussian with full covariance, which this refines. The bands are a Gaussian scale
    mixture: S. Lyu & E. P. Simoncelli, "Modeling multiscale subbands of photographic images with
    fields of Gaussian scale mixtures", PAMI 2009.
    """

    def __init__(
        self,
        statistics: DescriptorStatistics,
        *,
        made_with: str | None = None,
        noise: float = 0.0,
    ) -> None:
        self._statistics = statistics
        self.noise: float = checked_noise(repr(float(noise)))
        self.made_with: str | None = None if made_with is None else checked_made_with(made_with)
        self.n: int = statistics.n
        self.source_id: str = hashlib.sha256(self.to_bytes()).hexdigest()
        self._cumulative = np.cumsum(statistics.weights.astype(np.float64))
        self._spreads = np.ascontiguousarray(statistics.spreads.transpose(0, 2, 1), np.float64)

    def __repr__(self) -> str:
        return f"DecoyGenerator(n={self.n}, id {self.source_id[:12]})"

    def without_noise(self) -> "DecoyGenerator":
        """Return what draws faces as they are before lifting, not decoys."""
        return DecoyGenerator(self._statistics, made_with=self.made_with)

    @property
    def statistics(self) -> DescriptorStatistics:
        """The fitted statistics."""
        return self._statistics

    @classmethod
    def fit(
        cls,
        descriptors: NDArray[np.floating],
        *,
        made_with: str | None = None,
        noise: float = 0.0,
    ) -> Self:
        """Fit to real descriptors.

        Parameters
        ----------
        descriptors
            float32, shape (N, n), unit rows, N ≥ 100; several thousand give good decoys.
        made_with
            `templates.contract.binding.embedding_id` of the pack that gave them.
        noise
            As for the class.

        Raises
        ------
        DecoyError
            Too few descriptors, or descriptors that are not finite unit vectors or lie in a small
            subspace.
        """
        return cls(fit_statistics(descriptors), made_with=made_with, noise=noise)

    @classmethod
    def adapt(
        cls,
        descriptors: NDArray[np.floating],
        like: NDArray[np.floating],
        people: Sequence[str],
        *,
        made_with: str | None = None,
        noise: float = 0.0,
    ) -> Self:
        """Fit to many descriptors of any kind, adapted to few of the kind that is enrolled.

        Parameters
        ----------
        descriptors
            float32, shape (N, n), unit rows, N ≥ 100; tens of thousands give good decoys.
        like
            float32, shape (K, n), unit rows, K ≥ 100, of people who are not in ``descriptors`` and
            will not be enrolled.
        people
            K names of those people.
        made_with
            `templates.contract.binding.embedding_id` of the pack that gave all of them.
        noise
            As for the class.

        Raises
        ------
        DecoyError
            Too few of either, or descriptors that are not finite unit vectors or lie in a small
            subspace.
        """
        statistics = adapted_statistics(descriptors, like, people)
        return cls(statistics, made_with=made_with, noise=noise)

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
            descriptors, and choosing by the subject's attributes would leak them (docs/method.md
            §4.5).
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
        for start in range(0, len(decoys), _CHUNK):
            stop = min(start + _CHUNK, len(decoys))
            decoys[start:stop] = self._sample(stop - start, stream)
        return decoys.reshape(rows, k, self.n)

    def _sample(self, count: int, stream: Keystream) -> NDArray[np.float32]:
        statistics = self._statistics
        lead, edges = leading_axes(self.n), band_edges(self.n)
        uniform = stream.uniform((count,))
        # The weights may add up to slightly less than 1, hence the minimum.
        chosen = np.minimum(
            np.searchsorted(self._cumulative, uniform, side="right"), len(self._cumulative) - 1
        )
        noise = stream.normal((count, feature_count(self.n)))
        features = statistics.centres[chosen].astype(np.float64)
        for component in range(len(self._cumulative)):
            drawn = chosen == component
            features[drawn] += noise[drawn] @ self._spreads[component]
        z = np.empty((count, self.n), dtype=np.float32)
        z[:, :lead] = features[:, :lead]
        directions = stream.normal((count, self.n - lead))
        widths = np.diff(edges)
        squares = np.add.reduceat(directions**2, edges[:-1] - lead, axis=1) / widths
        # Clipped, because a hostile generator could make the exponential overflow.
        sizes = np.exp(np.clip(features[:, lead:], -20.0, 20.0)) / np.sqrt(squares)
        z[:, lead:] = directions * np.repeat(sizes, widths, axis=1)
        x = statistics.mean + z @ statistics.axes
        if self.noise:
            x = x + np.sqrt(self.noise) * stream.normal((count, self.n))
        norms = np.linalg.norm(x.astype(np.float64), axis=1, keepdims=True)
        if not (norms > _SMALLEST_NORM).all() or not np.isfinite(norms).all():
            raise DecoyError("the decoy generator makes vectors without a direction; fit it anew")
        return np.asarray(x / norms, dtype=np.float32)

    def to_bytes(self) -> bytes:
        """Serialise; equal generators give equal bytes, and `source_id` is their SHA-256."""
        fields: dict[str, str | int | list[str]] = {
            "format": GENERATOR_FORMAT,
            "version": GENERATOR_VERSION,
        }
        if self.made_with is not None:
            fields["made_with"] = self.made_with
        if self.noise:
            fields["noise"] = repr(self.noise)
        return container.encode(fields, {name: getattr(self._statistics, name) for name in _PARTS})

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
        made_with = take_made_with(fields)
        noise = checked_noise(fields.pop("noise", "0.0"))
        if fields != {"format": GENERATOR_FORMAT, "version": GENERATOR_VERSION}:
            raise DecoyError(f"this is not a decoy generator of version {GENERATOR_VERSION}")
        if set(arrays) != set(_PARTS) or any(a.dtype != np.float32 for a in arrays.values()):
            raise DecoyError("the decoy generator has missing or unknown parts")
        parts = {name: array.astype(np.float32) for name, array in arrays.items()}
        return cls(DescriptorStatistics(**parts), made_with=made_with, noise=noise)

    def save(self, path: Path) -> None:
        """Write the generator as a plain file, which clients may have.

        It holds no descriptor, but tells who holds a photo whether that person was in the fit,
        better than chance (docs/design-measurements.md).

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
