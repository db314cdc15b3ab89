"""What an evaluation computes on: descriptors, pairs and decoys, and how they travel to workers."""

import hashlib
import os
import pickle
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from numpy.typing import NDArray

from templates.decoys import Attributes, DecoyGenerator, DecoyPool

Source = DecoyPool | DecoyGenerator
_NONCE_BYTES = 12
KEY_BYTES = 32


@dataclass(frozen=True, eq=False, repr=False)
class Material:
    """Everything that scores depend on, besides a unit.

    Parameters
    ----------
    descriptors : (N, n) float32
        Unit rows of the photos that were acquired.
    flipped : (N, n) float32, optional
        The same with the mirror image added.
    first, second : (P,) int64
        Pairs of rows.
    same : (P,) bool
    folds : (P,) int64
    people : (2, P) int64, optional
        People on the first and on the second photo of each pair, where the set names people.
    attributes
        One per row, where hybrid+ is evaluated.
    sources
        Decoy sources, from which people of the set were removed.
    """

    descriptors: NDArray[np.float32]
    flipped: NDArray[np.float32] | None
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    same: NDArray[np.bool_]
    folds: NDArray[np.int64]
    people: NDArray[np.int64] | None
    attributes: Sequence[Attributes] | None
    sources: tuple[Source, ...]

    def __len__(self) -> int:
        return len(self.same)

    @property
    def n(self) -> int:
        """Dimension of the descriptors."""
        return int(self.descriptors.shape[1])


@dataclass(frozen=True, repr=False)
class Parcel:
    """Any value on its way to a worker, sealed under a key of this run.

    Pools of processes and cluster workers may put what they hold into temporary files when memory
    is short. They hold the parcel, and get the key with each task, which they do not write out.

    Parameters
    ----------
    sealed
        AES-256-GCM of the pickled value.
    digest
        SHA-256 of ``sealed``.
    """

    sealed: bytes
    digest: str

    @classmethod
    def pack(cls, value: object, key: bytes) -> Self:
        """Seal a value."""
        nonce = os.urandom(_NONCE_BYTES)
        plain = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)
        sealed = nonce + AESGCM(key).encrypt(nonce, plain, None)
        return cls(sealed, hashlib.sha256(sealed).hexdigest())

    def open(self, key: bytes) -> object:
        """Return the value; raise ``InvalidTag`` where the key is another or a byte changed."""
        nonce, sealed = self.sealed[:_NONCE_BYTES], self.sealed[_NONCE_BYTES:]
        plain = AESGCM(key).decrypt(nonce, sealed, None)
        # Only what this run has sealed is authentic, so nobody else's pickle gets here.
        return pickle.loads(plain)  # noqa: S301

    def __repr__(self) -> str:
        return f"Parcel({len(self.sealed)} sealed bytes)"


def fresh_key() -> bytes:
    """Return a key for the parcels of one run."""
    return os.urandom(KEY_BYTES)
