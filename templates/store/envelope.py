"""Envelope encryption of one template.

A subject's data key, 32 random bytes, is made anew with every enrollment and encrypts exactly one
template, so that a nonce cannot repeat under it. It is stored wrapped by the master key, bound to
the tenant and to the random row id of the subject. The template's ciphertext is bound to tenant,
row id, subject id, contract id, template id, rotation epoch and, where it needs a holder's key, the
salt of the holder's rotation: a row that is moved or relabelled does not open.
"""

import os

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from templates.errors import SealError
from templates.keys.sealing import NONCE_BYTES, TAG_BYTES, MasterKeyring, encode_parts
from templates.store.schema import SubjectRow

_VERSION = b"\x01"
DATA_KEY_PURPOSE = "subject-data-key"


def seal_template(subject: SubjectRow, wire: bytes, keyring: MasterKeyring) -> None:
    """Encrypt a template under a fresh data key, wrap that key, and put both into its row.

    All that the ciphertext is bound to stands in the row already.
    """
    data_key, nonce = os.urandom(32), os.urandom(NONCE_BYTES)
    body = AESGCM(data_key).encrypt(nonce, wire, _bound_to(subject))
    subject.ciphertext = _VERSION + nonce + body
    subject.wrapped_key = keyring.seal(
        data_key, purpose=DATA_KEY_PURPOSE, bound_to=[subject.tenant_id, subject.id]
    )


def open_template(subject: SubjectRow, keyring: MasterKeyring) -> bytes:
    """Decrypt a template; :class:`SealError` if it was altered or moved, or a key is missing."""
    data_key = keyring.open(
        subject.wrapped_key,
        purpose=DATA_KEY_PURPOSE,
        bound_to=[subject.tenant_id, subject.id],
    )
    sealed = subject.ciphertext
    if len(sealed) < 1 + NONCE_BYTES + TAG_BYTES or sealed[:1] != _VERSION:
        raise SealError("a sealed template is cut short, or of a version this program cannot read")
    try:
        return AESGCM(data_key).decrypt(
            sealed[1 : 1 + NONCE_BYTES], sealed[1 + NONCE_BYTES :], _bound_to(subject)
        )
    except InvalidTag:
        raise SealError(
            "a sealed template does not open: it was altered, or belongs to another subject"
        ) from None


def _bound_to(subject: SubjectRow) -> bytes:
    """Associated data of the ciphertext."""
    return encode_parts(
        "template",
        subject.tenant_id,
        subject.id,
        subject.subject_id,
        subject.contract_id,
        subject.template_id,
        subject.rotation_epoch,
        *(() if subject.holder_salt is None else (subject.holder_salt,)),
    )
