"""The secret rotations of templates: without the tenant's key, no two of them can be linked.

Each template has a rotation of its own (docs/method.md §4.9). It maps a descriptor x to R x, before
lifting or, which is the same, after it (``SubspaceBatch.turned_by``). A probe is turned as the
template that it is compared with, so no distance changes.

Where the person keeps a key, the holder's rotation comes first and the tenant's last: the tenant's
can be renewed, or undone for an export, without the holder's key.
"""

from dataclasses import dataclass

import numpy as np
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from numpy.typing import NDArray

from templates.keys.randomness import KEY_BYTES
from templates.keys.sealing import encode_parts

ROTATION_VERSION = "signs-hartley-1"
"""Names how a key and a template's id become a rotation; part of the contract."""
HOLDER_VERSION = "signs-hartley-1"
"""Names how a holder's key and the salt of an enrollment become a rotation."""
TRANSFORMS = 4
"""Transforms of one rotation. With four, the variance of any entry of R x over the keys is 1/n for
every unit vector x, to a relative 1/n (docs/method.md §4.9)."""

Array64 = NDArray[np.float64]
HolderKey = bytes | bytearray
"""The 32 secret bytes that the holder of an enrollment keeps, and the service does not."""


@dataclass(frozen=True, eq=False, repr=False)
class Rotation:
    """Random signs and orthonormal Hartley transforms in turn, with signs at both ends.

    Parameters
    ----------
    signs : (TRANSFORMS + 1, n) float64
        Each 1 or −1.
    """

    signs: Array64

    def turned(self, points: NDArray[np.floating]) -> Array64:
        """Return R x for every row."""
        turned = points * self.signs[0]
        for signs in self.signs[1:]:
            turned = _hartley(turned) * signs
        return np.asarray(turned)

    def turned_back(self, points: NDArray[np.floating]) -> Array64:
        """Return Rᵀ x for every row."""
        return Rotation(self.signs[::-1]).turned(points)


def _hartley(rows: Array64) -> Array64:
    """Orthonormal Hartley transform of every row, which undoes itself.

    References
    ----------
    R. N. Bracewell, "Discrete Hartley transform", JOSA 73(12), 1983.
    """
    spectrum = np.fft.fft(rows, norm="ortho")
    return np.asarray(spectrum.real - spectrum.imag)


class TenantRotation:
    """Gives each template that a tenant has in one epoch its rotation.

    `key` are the 32 secret bytes of tenant and epoch, `n` the dimension.
    """

    def __init__(self, key: bytes, n: int) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"a tenant's rotation key has {KEY_BYTES} bytes, not {len(key)}")
        if n < 1:
            raise ValueError(f"a rotation needs a dimension of 1 or more, not {n}")
        self._key = key
        self.n = n

    def __repr__(self) -> str:
        return f"TenantRotation(n={self.n})"

    def of(self, template_id: str) -> Rotation:
        """Return the rotation of one template, whose id is random. Equal everywhere to rounding.

        HKDF-SHA-256 turns the key, n and the id into the bits of all signs. The derived bits are
        the whole secret of this rotation: a person who finds out the rotation of their own template
        learns nothing about another's.
        """
        info = encode_parts("template rotation", ROTATION_VERSION, self.n, template_id)
        return _derived(self._key, info, self.n)


def holder_rotation(key: HolderKey, salt: str, n: int) -> Rotation:
    """Return the rotation of one enrollment under its holder's key, of n dimensions.

    The salt is random, and another one for each enrollment. It stays where the template gets
    another id: the holder's key is not there when a template is imported.
    """
    if len(key) != KEY_BYTES:
        raise ValueError(f"a holder key has {KEY_BYTES} bytes, not {len(key)}")
    return _derived(key, encode_parts("holder rotation", HOLDER_VERSION, n, salt), n)


def _derived(key: HolderKey, info: bytes, n: int) -> Rotation:
    count = (TRANSFORMS + 1) * n
    derived = HKDF(algorithm=SHA256(), length=-(-count // 8), salt=None, info=info).derive(key)
    bits = np.unpackbits(np.frombuffer(derived, dtype=np.uint8), count=count)
    signs = 1 - 2 * bits.astype(np.float64)
    return Rotation(signs.reshape(-1, n))
