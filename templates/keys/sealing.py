"""Encryption at rest: the master keys, and what is sealed directly under them.

A master key never encrypts anything itself. HKDF-SHA256 derives one AES-256-GCM key per purpose
from it, so that a blob of one purpose cannot stand in for a blob of another. A sealed blob is::

    version (1 byte) | key id (8) | nonce (12) | ciphertext and tag (len(plaintext) + 16)

Nonces are random; a purpose key may seal 2**32 blobs (NIST SP 800-38D §8.3), which no deployment
of this size reaches. The associated data holds the header and the parts that the caller binds the
blob to, each with its length in front, so that no two lists of parts have the same encoding.
"""

import hashlib
import os
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn, Self

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from templates.errors import SealError
from templates.keys.key_file import (
    KEY_BYTES,
    Stamp,
    check_keys,
    keys_in,
    read_key_file,
    stamp_of,
    write_key_file,
)

KEY_ID_BYTES = 8
NONCE_BYTES = 12
TAG_BYTES = 16
OVERHEAD_BYTES = 1 + KEY_ID_BYTES + NONCE_BYTES + TAG_BYTES

_VERSION = 1
_FILE_PURPOSE = "sealer/file"


def encode_parts(*parts: str | bytes | int) -> bytes:
    """Encode parts injectively: their count, then type, length and bytes of each.

    Text is taken as UTF-8, a whole number in decimal.
    """
    encoded = [len(parts).to_bytes(4, "big")]
    for part in parts:
        match part:
            case str():
                kind, body = b"t", part.encode()
            case bytes():
                kind, body = b"b", part
            case int():
                kind, body = b"i", str(part).encode()
        encoded += [kind, len(body).to_bytes(8, "big"), body]
    return b"".join(encoded)


def derive_key(key: bytes, label: str) -> bytes:
    """Derive 32 bytes for one purpose from a uniformly random key (HKDF-SHA256, RFC 5869)."""
    return HKDF(SHA256(), KEY_BYTES, salt=None, info=b"veilface/1/" + label.encode()).derive(key)


class MasterKeyring:
    """The master keys of a deployment; the first seals, all of them open.

    Use :meth:`load`, :meth:`create` or :meth:`from_environment`. A keyring that came from a file
    follows the file: when it changes, the keys are read again at the next seal, or when a blob
    names a key that is not in memory. So a running service picks up a rotation without a restart.
    The environment of a process never changes.

    `keys` have 32 random bytes each, the current one first; `source` is what error texts call the
    place they came from. A keyring without a key, or with one of another length or a repeated one,
    is a :class:`SealError`.
    """

    def __init__(self, keys: Sequence[bytes], *, source: str = "the master keyring") -> None:
        self._source = source
        self._path: Path | None = None
        self._stamp: Stamp | None = None
        self._not_followed: str | None = None
        self._lock = threading.Lock()
        self._keys = _Keys(keys, source=source)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a key file: one base64 key of 32 bytes on a line, the current one first.

        :class:`SealError` if it is absent, readable by group or others, or holds anything else.
        """
        path = Path(path)
        keys, stamp = read_key_file(path)
        keyring = cls(keys, source=f"the key file {path}")
        keyring._path, keyring._stamp = path, stamp
        return keyring

    @classmethod
    def create(cls, path: str | Path) -> Self:
        """Write a new key file with one random key, mode 0600, and load it.

        The file appears whole or not at all, and an existing one is never touched, so of several
        processes that try at once exactly one succeeds; the others get a :class:`SealError`.
        """
        path = Path(path)
        write_key_file(path, [os.urandom(KEY_BYTES)], replace=False)
        return cls.load(path)

    @classmethod
    def from_environment(cls, name: str) -> Self:
        """Read the keys from an environment variable, in the form of a key file.

        A space or a comma may stand in the place of a line break.
        """
        source = f"the environment variable {name}"
        text = os.environ.get(name)
        if text is None:
            raise SealError(
                f"{source} is not set: give it the master keys in base64, the current one first"
            )
        return cls(keys_in("\n".join(text.replace(",", " ").split()), source=source), source=source)

    @staticmethod
    def add_current(path: str | Path) -> str:
        """Put a new random key in front of a key file's keys; returns its key id.

        The file is replaced in one step. Afterwards wrap the store again, then
        :meth:`drop_retired`. Call both inside a write of the store: it keeps other rotations out.
        """
        path = Path(path)
        keys, _ = read_key_file(path)
        fresh = os.urandom(KEY_BYTES)
        write_key_file(path, [fresh, *keys], replace=True)
        return _key_id(fresh)

    @staticmethod
    def drop_retired(path: str | Path, *, keep: str) -> int:
        """Keep only the first key of a key file; returns how many were dropped.

        Whatever is still sealed under a dropped key is lost: ask
        ``templates.store.count_wrapped`` first. `keep` is the id of the key that everything
        was found to be sealed under; where another one is the first by now, or the file cannot be
        replaced, a :class:`SealError` says so and no key is dropped.
        """
        path = Path(path)
        keys, _ = read_key_file(path)
        if (first := _key_id(keys[0])) != keep:
            raise SealError(
                f"the first key of the key file {path} is {first}, but what was checked is "
                f"sealed under {keep}; the file changed meanwhile, and no key was dropped: "
                "run `veilface keys rewrap --retire`"
            )
        if len(keys) > 1:
            write_key_file(path, keys[:1], replace=True)
        return len(keys) - 1

    @property
    def current(self) -> str:
        """Key id, 16 hexadecimal digits, of the key that seals."""
        return self.key_ids[0]

    @property
    def key_ids(self) -> tuple[str, ...]:
        """Ids of all keys, 16 hexadecimal digits each, the current one first."""
        self._follow_file()
        return self._keys.ids

    @property
    def stale_reason(self) -> str | None:
        """Why the keys in memory may be old ones: how reading the changed file failed.

        They stay in use meanwhile. None where nothing failed.
        """
        self._follow_file()
        return self._not_followed

    def seal(
        self, plaintext: bytes, *, purpose: str, bound_to: Sequence[str | bytes | int]
    ) -> bytes:
        """Encrypt under the current key, derived for a purpose.

        The blob opens only with the same purpose, and the parts that it is bound to.
        :class:`SealError` for 2 GiB or more, which one call of the cipher does not take.
        """
        self._follow_file()
        keys = self._keys
        header = bytes([_VERSION]) + bytes.fromhex(keys.ids[0])
        nonce = os.urandom(NONCE_BYTES)
        cipher = AESGCM(keys.derived(keys.ids[0], purpose))
        try:
            sealed = cipher.encrypt(nonce, plaintext, _bind(header, purpose, bound_to))
        except OverflowError:
            raise SealError("less than 2 GiB can be sealed at once: divide the file") from None
        return header + nonce + sealed

    def open(self, sealed: bytes, *, purpose: str, bound_to: Sequence[str | bytes | int]) -> bytes:
        """Decrypt what :meth:`seal` made with the same purpose and parts.

        :class:`SealError` if it names an unknown key, belongs to something else, or was altered.
        """
        key_id = sealed_key_id(sealed)
        if key_id not in self._keys.ids:
            self._follow_file()
        keys = self._keys
        if key_id not in keys.ids:
            raise SealError(
                f"sealed under master key {key_id}, but {self._source} has only "
                f"{', '.join(keys.ids)}: put the missing key back as a further line"
            )
        header, nonce = sealed[: 1 + KEY_ID_BYTES], sealed[1 + KEY_ID_BYTES :][:NONCE_BYTES]
        cipher = AESGCM(keys.derived(key_id, purpose))
        try:
            return cipher.decrypt(
                nonce,
                sealed[1 + KEY_ID_BYTES + NONCE_BYTES :],
                _bind(header, purpose, bound_to),
            )
        except InvalidTag:
            raise SealError(
                f"sealed data ({purpose}) does not open: it was altered, or belongs elsewhere"
            ) from None

    def rewrap(
        self, sealed: bytes, *, purpose: str, bound_to: Sequence[str | bytes | int]
    ) -> bytes:
        """Open a blob and seal it again under the current key."""
        plaintext = self.open(sealed, purpose=purpose, bound_to=bound_to)
        return self.seal(plaintext, purpose=purpose, bound_to=bound_to)

    def _follow_file(self) -> None:
        if self._path is None:
            return
        # A file that is broken at this moment must not stop a service that has its keys: a blob
        # under a key that is not in memory still fails, with the id of that key.
        try:
            if stamp_of(self._path.stat()) != self._stamp:
                with self._lock:
                    keys, stamp = read_key_file(self._path)
                    self._keys, self._stamp = _Keys(keys, source=self._source), stamp
        except OSError as error:
            self._not_followed = f"{self._source} cannot be read: {error.strerror}"
        except SealError as error:
            self._not_followed = str(error)
        else:
            self._not_followed = None

    def __repr__(self) -> str:
        return f"MasterKeyring({', '.join(self._keys.ids)})"

    def __reduce__(self) -> NoReturn:
        raise TypeError("a master keyring is not serialised: load it where it is needed")


class Sealer:
    """Seals files under a master keyring: decoy pools, contracts, caches."""

    def __init__(self, keyring: MasterKeyring) -> None:
        self._keyring = keyring

    def seal(self, plaintext: bytes, *, context: str) -> bytes:
        """Encrypt `plaintext`, bound to `context`."""
        return self._keyring.seal(plaintext, purpose=_FILE_PURPOSE, bound_to=[context])

    def open(self, sealed: bytes, *, context: str) -> bytes:
        """Decrypt; :class:`SealError` for another key or context, or an altered byte."""
        return self._keyring.open(sealed, purpose=_FILE_PURPOSE, bound_to=[context])

    def __repr__(self) -> str:
        return f"Sealer({self._keyring!r})"


def sealed_key_id(sealed: bytes) -> str:
    """Id, 16 hexadecimal digits, of the master key that a blob was sealed under."""
    if len(sealed) < OVERHEAD_BYTES:
        raise SealError(f"sealed data has at least {OVERHEAD_BYTES} bytes, this has {len(sealed)}")
    if sealed[0] != _VERSION:
        raise SealError(f"sealed data of version {sealed[0]}, this program reads {_VERSION}")
    return sealed[1 : 1 + KEY_ID_BYTES].hex()


class _Keys:
    """An immutable set of checked keys by their ids, and the keys derived from them so far."""

    def __init__(self, keys: Sequence[bytes], *, source: str) -> None:
        check_keys(keys, source=source)
        self._masters = {_key_id(key): key for key in keys}
        self._derived: dict[tuple[str, str], bytes] = {}
        self.ids = tuple(self._masters)

    def derived(self, key_id: str, purpose: str) -> bytes:
        key = self._derived.get((key_id, purpose))
        if key is None:
            key = derive_key(self._masters[key_id], f"seal/{purpose}")
            self._derived[key_id, purpose] = key
        return key


def _bind(header: bytes, purpose: str, bound_to: Sequence[str | bytes | int]) -> bytes:
    return header + encode_parts(purpose, *bound_to)


def _key_id(key: bytes) -> str:
    return hashlib.sha256(derive_key(key, "key-id")).hexdigest()[: 2 * KEY_ID_BYTES]
