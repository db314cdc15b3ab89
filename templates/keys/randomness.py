"""Random samples from a ChaCha20 keystream.

The generator is a cryptographic one (docs/method.md §2.3): a thief who sees a template must not
be able to predict the randomness of the next one, as they could with PCG64 or the Mersenne Twister.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from typing import Self

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
from numpy.typing import NDArray

KEY_BYTES = 32
_SEED_DOMAIN = b"veilface seeded keystream 1\x00"
_TILE = 1 << 16

Shape = int | tuple[int, ...]


class Keystream:
    """ChaCha20 keystream turned into samples; the only source of randomness of ``templates``.

    Every enrollment gets a stream of its own, from :meth:`fresh` or from a secret; experiments
    share one :meth:`seeded` stream.

    Examples
    --------
    >>> Keystream.seeded("example", 1).choose(5, rows=1, k=2).shape
    (1, 2)
    """

    __slots__ = ("_cipher",)

    def __init__(self, key: bytes | bytearray) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"a keystream key has {KEY_BYTES} bytes, not {len(key)}")
        # The nonce may be constant, because a key is used for one stream only.
        self._cipher = Cipher(ChaCha20(bytes(key), bytes(16)), mode=None).encryptor()

    @classmethod
    def fresh(cls) -> Self:
        """Return a stream under a new key from the operating system."""
        return cls(os.urandom(KEY_BYTES))

    @classmethod
    def seeded(cls, *parts: str | int) -> Self:
        """Return the stream that belongs to ``parts``, which anybody who knows them can make.

        For evaluations and calibrations that must be repeatable, never for a secret.

        ``1`` and ``"1"`` are different parts, and ``("ab",)`` differs from ``("a", "b")``.
        """
        if not parts:
            raise ValueError("a seeded keystream needs at least one part")
        canonical = json.dumps(parts, ensure_ascii=True, separators=(",", ":")).encode()
        return cls(hashlib.sha256(_SEED_DOMAIN + canonical).digest())

    def __repr__(self) -> str:
        return "Keystream()"

    def __reduce__(self) -> str | tuple[object, ...]:
        raise TypeError("a keystream is not copied or stored: two copies would repeat each other")

    def token(self, nbytes: int) -> bytes:
        """Return ``nbytes`` bytes of the stream."""
        return self._cipher.update(bytes(nbytes))

    def uniform(self, shape: Shape, low: float = 0.0, high: float = 1.0) -> NDArray[np.float64]:
        """Sample U([low, high)) with 53 random bits each, as float64 of ``shape``."""
        out = np.empty(shape, dtype=np.float64)
        for tile in _tiles(out):
            tile[:] = self._shares(tile.size)
            tile *= high - low
            tile += low
        return out

    def normal(self, shape: Shape) -> NDArray[np.float64]:
        """Sample N(0, 1) in pairs from two uniforms each, as float64 of ``shape``.

        References
        ----------
        G. E. P. Box & M. E. Muller, "A note on the generation of random normal deviates", Annals of
        Mathematical Statistics 29(2), 1958.
        """
        out = np.empty(shape, dtype=np.float64)
        for tile in _tiles(out):
            half = (tile.size + 1) // 2
            radii = np.sqrt(-2 * np.log(1 - self._shares(half)))  # of (0, 1]: 0 has no logarithm
            angles = 2 * np.pi * self._shares(half)
            tile[:half] = radii * np.cos(angles)
            tile[half:] = (radii * np.sin(angles))[: tile.size - half]
        return out

    def _shares(self, count: int) -> NDArray[np.float64]:
        """Sample multiples of 2⁻⁵³ in [0, 1)."""
        words = np.frombuffer(self.token(8 * count), dtype=np.uint64)
        return np.asarray((words >> np.uint64(11)) * 2.0**-53)

    def integers(self, bound: int, size: int) -> NDArray[np.int64]:
        """Sample ``size`` integers of 0 … ``bound`` − 1, exactly uniform, by rejection."""
        if not 1 <= bound <= 2**62:
            raise ValueError(f"the bound must lie between 1 and 2**62, not {bound}")
        # Words of the last, incomplete run of `bound` values would favour the small integers.
        surplus = 2**64 % bound
        words = np.empty(size, dtype=np.uint64)
        pending = np.arange(size)
        while pending.size:
            drawn = np.frombuffer(self.token(8 * pending.size), dtype=np.uint64)
            words[pending] = drawn
            pending = pending[drawn > np.uint64(2**64 - 1 - surplus)]
        return (words % np.uint64(bound)).astype(np.int64)

    def choose(self, population: int, rows: int, k: int) -> NDArray[np.int64]:
        """Sample ``k`` different integers of 0 … ``population`` − 1 in every row, int64 (rows, k).

        Every ordered selection has the same probability. By Floyd's algorithm (Bentley & Floyd,
        CACM 1987), a column at a time for all rows, then Fisher–Yates for the order.
        """
        if not 0 <= k <= population:
            raise ValueError(f"cannot choose {k} different integers out of {population}")
        chosen = np.full((rows, k), -1, dtype=np.int64)
        for column, last in enumerate(range(population - k, population)):
            drawn = self.integers(last + 1, rows)
            taken = (chosen[:, :column] == drawn[:, None]).any(axis=1)
            chosen[:, column] = np.where(taken, last, drawn)
        every = np.arange(rows)
        for column in range(k - 1, 0, -1):
            other = self.integers(column + 1, rows)
            swapped = chosen[every, other]
            chosen[every, other] = chosen[:, column]
            chosen[:, column] = swapped
        return chosen


def _tiles(samples: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Views of a new array that stay in the processor's cache; bounds temporary memory too."""
    flat = samples.reshape(-1)
    for start in range(0, flat.size, _TILE):
        yield flat[start : start + _TILE]
