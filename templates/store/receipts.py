"""Signed erasure receipts.

A receipt is a canonical JSON text (``templates.contract.canonical``) and its Ed25519 signature
(RFC 8032). It names the subject by a pseudonym, HMAC-SHA256 of tenant and subject id under a secret
of the deployment: a caller with the subject id can ask the deployment for the receipt, and nobody
else learns whom it is about. The receipt of a whole tenant is of another kind, and names the
tenant.
"""

import base64
import contextlib
import hashlib
import hmac
import json
import unicodedata
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from sqlalchemy.orm import Session

from templates.contract.canonical import canonical_json
from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.schema import ReceiptRow
from templates.store.secrets import SecretName, Secrets

SUBJECT_KIND = "veilface-erasure-receipt"
TENANT_KIND = "veilface-tenant-erasure-receipt"
_VERSION = 1


@dataclass(frozen=True)
class Receipt:
    """Proof that the data of a subject or of a tenant was erased, or that none was held.

    Attributes
    ----------
    body
        Canonical JSON: kind, version, receipt_id, tenant, erased_at, held, erased (list of item
        and count), signing_key (:func:`key_fingerprint`). Of a subject also subject (pseudonym) and
        contract_id (null where nothing was held); of a tenant also rotation_epoch, the last one.
    signature
        64 bytes, Ed25519 over the UTF-8 bytes of `body`.
    """

    body: str
    signature: bytes = field(repr=False)

    @property
    def claims(self) -> dict[str, Any]:
        """The body, read."""
        claims: dict[str, Any] = json.loads(self.body)
        return claims

    def to_json(self) -> dict[str, Any]:
        """The form that a client keeps and :func:`verify_receipt` takes."""
        return {"body": self.body, "signature": base64.b64encode(self.signature).decode()}

    @classmethod
    def from_json(cls, value: object) -> "Receipt":
        """Read :meth:`to_json`'s form; :class:`StoreError` for anything else."""
        match value:
            case {"body": str(body), "signature": str(signature), **rest} if not rest:
                with contextlib.suppress(ValueError):
                    return cls(body, base64.b64decode(signature, validate=True))
        raise StoreError("a receipt is an object with a text `body` and a base64 `signature`")


class ReceiptSigner:
    """Makes pseudonyms and receipts with the deployment's secrets."""

    def __init__(self, secrets: Secrets) -> None:
        self._secrets = secrets

    def pseudonym(self, tenant: str, subject_id: str) -> str:
        """Keyed pseudonym, 64 hexadecimal digits, of one subject of one tenant, spelled anyhow."""
        secret = self._secrets.get(SecretName.PSEUDONYM)
        parts = encode_parts(tenant, unicodedata.normalize("NFC", subject_id))
        return hmac.digest(secret, parts, hashlib.sha256).hex()

    def public_key(self) -> bytes:
        """The 32 bytes that verify this deployment's receipts."""
        return public_key_of(self._secrets.get(SecretName.RECEIPT))

    def sign(
        self, kind: str, *, erased: Mapping[str, int], erased_at: datetime, **claims: Any
    ) -> Receipt:
        """Write and sign a receipt of a kind, with a random id and these claims."""
        body = {
            "kind": kind,
            "version": _VERSION,
            "receipt_id": uuid.uuid4().hex,
            "erased_at": erased_at.isoformat(),
            **claims,
            "erased": [{"item": item, "count": count} for item, count in erased.items()],
        }
        return sign_claims(body, self._secrets.get(SecretName.RECEIPT))


def sign_claims(claims: dict[str, Any], private_key: bytes) -> Receipt:
    """Write claims as canonical JSON, which names its key, and sign it."""
    private = Ed25519PrivateKey.from_private_bytes(private_key)
    public_key = private.public_key().public_bytes_raw()
    body = canonical_json({**claims, "signing_key": key_fingerprint(public_key)})
    return Receipt(body.decode(), private.sign(body))


def public_key_of(private_key: bytes) -> bytes:
    """The 32 bytes that verify what a private key signs."""
    return Ed25519PrivateKey.from_private_bytes(private_key).public_key().public_bytes_raw()


def key_fingerprint(public_key: bytes) -> str:
    """First 16 hexadecimal digits of a public key's SHA-256, to tell keys apart."""
    return hashlib.sha256(public_key).hexdigest()[:16]


def tenant_receipt_name(tenant: str) -> str:
    """Column ``pseudonym`` of a tenant's receipts. Not secret: the receipt names the tenant."""
    return hashlib.sha256(encode_parts("tenant erasure", tenant)).hexdigest()


def keep_receipt(session: Session, pseudonym: str, receipt: Receipt) -> None:
    """Store a receipt under a subject's pseudonym, or a :func:`tenant_receipt_name`."""
    row = ReceiptRow(pseudonym=pseudonym, body=receipt.body, signature=receipt.signature)
    session.add(row)


def latest_receipt(session: Session, pseudonym: str) -> Receipt | None:
    """The last receipt that :func:`keep_receipt` stored under a name, or None."""
    of_name = sa.select(ReceiptRow).where(ReceiptRow.pseudonym == pseudonym)
    row = session.scalars(of_name.order_by(ReceiptRow.sequence.desc()).limit(1)).one_or_none()
    return None if row is None else Receipt(row.body, row.signature)


def verify_receipt(receipt: Receipt, public_key: bytes) -> dict[str, Any]:
    """Check the signature and the form of a subject's or a tenant's receipt; return its claims.

    :class:`StoreError` if it was not signed with this key, was altered, or is no erasure receipt.
    """
    claims = verify_claims(receipt, public_key)
    if claims.get("kind") not in (SUBJECT_KIND, TENANT_KIND) or claims.get("version") != _VERSION:
        raise StoreError("the signed text is not an erasure receipt of version 1")
    return claims


def verify_claims(signed: Receipt, public_key: bytes) -> dict[str, Any]:
    """Check the signature of what :func:`sign_claims` signed; return the claims."""
    try:
        key = Ed25519PublicKey.from_public_bytes(public_key)
    except ValueError:
        raise StoreError("the public key of a deployment has 32 bytes") from None
    try:
        key.verify(signed.signature, signed.body.encode())
    except InvalidSignature:
        raise StoreError(
            "the receipt does not carry this deployment's signature: "
            "it was altered, or another deployment signed it"
        ) from None
    return signed.claims


def sign_again(session: Session, old_key: bytes, new_key: bytes) -> int:
    """Sign every receipt that the deployment keeps anew, in a write; returns how many.

    One whose signature under the old private key does not hold stays as it is.
    """
    public_key, count = public_key_of(old_key), 0
    for row in session.scalars(sa.select(ReceiptRow)):
        with contextlib.suppress(StoreError):
            claims = verify_receipt(Receipt(row.body, row.signature), public_key)
            receipt = sign_claims(claims, new_key)
            row.body, row.signature = receipt.body, receipt.signature
            count += 1
    return count
