"""The secret rotation of a tenant: templates of two tenants cannot be linked (docs/method.md §4.9).

The rotation maps a descriptor x to R x, before lifting or, which is the same, after it
(``AffineSubspace.rotated``). Distances inside a tenant do not change.
"""

import numpy as np
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF
from numpy.typing import ArrayLike, NDArray

from templates.keys.randomness import KEY_BYTES, Keystream

ROTATION_VERSION = "haar-1"
"""Names how a key becomes a matrix; part of the contract."""


def tenant_rotation(key: bytes, n: int) -> NDArray[np.float64]:
    """Return the rotation that belongs to a tenant's key.

    Parameters
    ----------
    key : bytes
        32 secret bytes.
    n : int
        Descriptor dimension.

    Returns
    -------
    ndarray of float64, shape (n, n)
        Orthogonal; distributed by the Haar measure over the keys. Equal on every machine to
        rounding (10⁻¹³).

    Notes
    -----
    HKDF-SHA-256 turns key and n into a ChaCha20 key, whose stream fills a Gaussian matrix. Its Q
    factor is Haar-distributed when R has a positive diagonal (Mezzadri, Notices AMS 2007).
    """
    if len(key) != KEY_BYTES:
        raise ValueError(f"a tenant's rotation key has {KEY_BYTES} bytes, not {len(key)}")
    if n < 1:
        raise ValueError(f"a rotation needs a dimension of 1 or more, not {n}")
    info = f"veilface tenant rotation {ROTATION_VERSION} n={n}".encode()
    derived = HKDF(algorithm=SHA256(), length=KEY_BYTES, salt=None, info=info).derive(key)
    with Keystream(derived) as stream:
        q, r = np.linalg.qr(stream.normal((n, n)))
    return np.ascontiguousarray(q * np.where(np.diagonal(r) < 0, -1.0, 1.0))


def rotate(points: ArrayLike, rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R x for every row x of ``points``, shape (k, n) or (n,), in float64."""
    return np.asarray(np.asarray(points, dtype=np.float64) @ rotation.T)
