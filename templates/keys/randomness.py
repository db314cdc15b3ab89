"""Random samples from a ChaCha20 keystream.

The generator is a cryptographic one (docs/method.md §2.3): a thief who sees a template must not
be able to predict the randomness of the next one, as they could with PCG64 or the Mersenne Twister.
"""

import hashlib
import json
import os
from typing import Self

import numpy as np
from cryptography.hazmat.primitives.ciphers import Cipher
from cryptography.hazmat.primitives.ciphers.algorithms import ChaCha20
from numpy.typing import NDArray

KEY_BYTES = 32
_SEED_DOMAIN = b"veilface seeded keystream 1\x00"
# Samples are made in tiles that stay in the processor's cache; also bounds temporary memory.
_TILE = 1 << 16
_ZEROS = bytes(8 * _TILE)

Shape = int | tuple[int, ...]

# Numerators and denominators of Wichura's approximations, the highest power first.
_CENTRE = (
    (2509.0809287301226727, 33430.575583588128105, 67265.770927008700853, 45921.953931549871457,
     13731.693765509461125, 1971.5909503065514427, 133.14166789178437745, 3.3871328727963666080),
    (5226.4952788528545610, 28729.085735721942674, 39307.895800092710610, 21213.794301586595867,
     5394.1960214247511077, 687.18700749205790830, 42.313330701600911252, 1.0),
)  # fmt: skip
_NEAR_TAIL = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1,
     1.27045825245236838258, 3.64784832476320460504, 5.76949722146069140550,
     4.63033784615654529590, 1.42343711074968357734),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2,
     1.48103976427480074590e-1, 6.89767334985100004550e-1, 1.67638483018380384940,
     2.05319162663775882187, 1.0),
)  # fmt: skip
_FAR_TAIL = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3,
     2.65321895265761230930e-2, 2.96560571828504891230e-1, 1.78482653991729133580,
     5.46378491116411436990, 6.65790464350110377720),
    (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5,
     7.86869131145613259100e-4, 1.48753612908506148525e-2, 1.36929880922735805310e-1,
     5.99832206555887937690e-1, 1.0),
)  # fmt: skip


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

    def _words(self, out: NDArray[np.uint64]) -> NDArray[np.uint64]:
        """Fill a contiguous array of at most ``_TILE`` words."""
        self._cipher.update_into(memoryview(_ZEROS)[: out.nbytes], out.view(np.uint8).data)
        return out

    def uniform(self, shape: Shape, low: float = 0.0, high: float = 1.0) -> NDArray[np.float64]:
        """Sample U([low, high)) with 53 random bits each, as float64 of ``shape``."""
        out = np.empty(shape, dtype=np.float64)
        flat = out.reshape(-1)
        words = np.empty(min(_TILE, flat.size), dtype=np.uint64)
        for start in range(0, flat.size, _TILE):
            tile = flat[start : start + _TILE]
            drawn = self._words(words[: tile.size])
            np.right_shift(drawn, np.uint64(11), out=drawn)
            np.multiply(drawn, (high - low) * 2.0**-53, out=tile, casting="unsafe")
            if low:
                tile += low
        return out

    def normal(self, shape: Shape) -> NDArray[np.float64]:
        """Sample N(0, 1) by the inverse distribution function, as float64 of ``shape``.

        The uniforms are odd multiples of 2⁻⁵³, so 0 and 1 (infinite normals) never occur, and a
        sample costs one word of the stream whatever its value.
        """
        out = np.empty(shape, dtype=np.float64)
        flat = out.reshape(-1)
        words = np.empty(min(_TILE, flat.size), dtype=np.uint64)
        for start in range(0, flat.size, _TILE):
            tile = flat[start : start + _TILE]
            drawn = self._words(words[: tile.size])
            np.right_shift(drawn, np.uint64(12), out=drawn)
            np.add(drawn, 0.5, out=tile, casting="unsafe")
            tile *= 2.0**-52
            tile[:] = _normal_quantile(tile)
        return out

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
            pending = pending[drawn >= np.uint64(2**64 - surplus)] if surplus else pending[:0]
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


def _normal_quantile(shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantiles of N(0, 1) at shares in (0, 1), to a relative 1e-15.

    References
    ----------
    M. J. Wichura, "Algorithm AS 241: The percentage points of the normal distribution", Applied
    Statistics 37(3), 1988.
    """
    middle = shares - 0.5
    out = middle * _ratio(_CENTRE, 0.180625 - middle * middle)
    outside = np.flatnonzero(np.abs(middle) > 0.425)
    tail = np.sqrt(-np.log(np.minimum(shares[outside], 1 - shares[outside])))
    quantiles = _ratio(_NEAR_TAIL, tail - 1.6)
    far = tail > 5
    quantiles[far] = _ratio(_FAR_TAIL, tail[far] - 5)
    out[outside] = np.copysign(quantiles, middle[outside])
    return out


def _ratio(
    parts: tuple[tuple[float, ...], tuple[float, ...]], x: NDArray[np.float64]
) -> NDArray[np.float64]:
    above, below = (_polynomial(powers, x) for powers in parts)
    above /= below
    return above


def _polynomial(powers: tuple[float, ...], x: NDArray[np.float64]) -> NDArray[np.float64]:
    total = np.full_like(x, powers[0])
    for power in powers[1:]:
        total *= x
        total += power
    return total
