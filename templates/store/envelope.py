"""Envelope encryption of one template.

A subject's data key, 32 random bytes, is made anew with every enrollment and encrypts exactly one
template, so that a nonce cannot repeat under it. It is stored wrapped by the master key, bound to
the tenant and to the random row id of the subject. The template's ciphertext is bound to tenant,
row id, subject id, contract id, template id, rotation epoch and, where it needs a holder's key, the
salt of the holder's rotation: a row that is moved or relabelled does not open.
"""

import os
from dataclasses import dataclass, field

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from templates.errors import SealError
from templates.keys.sealing import NONCE_BYTES, TAG_BYTES, MasterKeyring, encode_parts

_VERSION = b"\x01"
DATA_KEY_PURPOSE = "subject-data-key"


@dataclass(frozen=True)
class Owner:
    """What a template's ciphertext belongs to."""

    tenant_id: str
    subject_pk: str
    subject_id: str
    contract_id: str
    template_id: str
    rotation_epoch: int
    holder_salt: str | None = None

    @property
    def bound_to(self) -> bytes:
        """Associated data of the ciphertext."""
        return encode_parts(
            "template",
            self.tenant_id,
            self.subject_pk,
            self.subject_id,
            self.contract_id,
            self.template_id,
            self.rotation_epoch,
            *(() if self.holder_salt is None else (self.holder_salt,)),
        )


@dataclass(frozen=True)
class Envelope:
    """A template as it is stored: its wrapped data key, and its ciphertext."""

    wrapped_key: bytes = field(repr=False)
    ciphertext: bytes = field(repr=False)


def close_envelope(wire: bytes, owner: Owner, keyring: MasterKeyring) -> Envelope:
    """Encrypt a template under a fresh data key, and wrap that key."""
    data_key, nonce = os.urandom(32), os.urandom(NONCE_BYTES)
    body = AESGCM(data_key).encrypt(nonce, wire, owner.bound_to)
    return Envelope(
        wrapped_key=keyring.seal(
            data_key,
            purpose=DATA_KEY_PURPOSE,
            bound_to=[owner.tenant_id, owner.subject_pk],
        ),
        ciphertext=_VERSION + nonce + body,
    )


def open_envelope(envelope: Envelope, owner: Owner, keyring: MasterKeyring) -> bytes:
    """Decrypt a template; :class:`SealError` if it was altered or moved, or a key is missing."""
    data_key = keyring.open(
        envelope.wrapped_key,
        purpose=DATA_KEY_PURPOSE,
        bound_to=[owner.tenant_id, owner.subject_pk],
    )
    sealed = envelope.ciphertext
    if len(sealed) < 1 + NONCE_BYTES + TAG_BYTES or sealed[:1] != _VERSION:
        raise SealError("a sealed template is cut short, or of a version this program cannot read")
    try:
        return AESGCM(data_key).decrypt(
            sealed[1 : 1 + NONCE_BYTES], sealed[1 + NONCE_BYTES :], owner.bound_to
        )
    except InvalidTag:
        raise SealError(
            "a sealed template does not open: it was altered, or belongs to another subject"
        ) from None
