"""Signed erasure receipts.

A receipt is a canonical JSON text (``templates.contract.canonical``) and its Ed25519 signature
(RFC 8032). It names the subject by a pseudonym, HMAC-SHA256 of tenant and subject id under a key of
the deployment: whoever holds the subject id and asks the deployment can find the receipt, nobody
else learns whom it is about. The receipt of a whole tenant is of another kind, and names the
tenant.

Both keys can be renewed. A receipt under a retired key is good if it is dated before the key was
retired; as whoever took that key can date receipts back, the renewal signs every receipt that the
deployment keeps again.
"""

import base64
import binascii
import hashlib
import json
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from sqlalchemy.engine import Connection

from templates.contract.canonical import canonical_json
from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.deployment import Secrets
from templates.store.schema import ReceiptRow
from templates.store.secret import SecretName

SUBJECT_KIND = "veilface-erasure-receipt"
TENANT_KIND = "veilface-tenant-erasure-receipt"
_VERSION = 1


@dataclass(frozen=True)
class Erased:
    """What one erasure removed, in numbers of records.

    Attributes
    ----------
    contract_id
        Contract of the template; None where there was none.
    template, data_key, metadata
        1 or 0: they come and go together.
    failed_attempts
        Records that named the subject by its pseudonym.
    """

    contract_id: str | None
    template: int
    data_key: int
    metadata: int
    failed_attempts: int

    @property
    def items(self) -> list[dict[str, Any]]:
        """Every kind of record with its count, in the order above."""
        return [
            {"item": item.name, "count": getattr(self, item.name)}
            for item in fields(self)
            if item.name != "contract_id"
        ]


@dataclass(frozen=True)
class ErasedTenant:
    """What the erasure of a tenant removed, in numbers of records.

    Attributes
    ----------
    subjects, templates, data_keys
        A data key is a column of the subject's row.
    rotation_keys
        Keys of the tenant's rotation, one for each epoch that was left.
    api_keys
        API keys, those that were revoked or had expired before included.
    failed_attempts, nonces
        Records of lockout, and of challenges and tokens that were used.
    """

    subjects: int
    templates: int
    data_keys: int
    rotation_keys: int
    api_keys: int
    failed_attempts: int
    nonces: int

    @property
    def items(self) -> list[dict[str, Any]]:
        """Every kind of record with its count, in the order above."""
        return [{"item": item.name, "count": getattr(self, item.name)} for item in fields(self)]


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

    @property
    def held(self) -> bool:
        """Whether there was a template, or a tenant, to erase."""
        return bool(self.claims["held"])

    def to_json(self) -> dict[str, Any]:
        """The form that a client keeps and :func:`verify_receipt` takes."""
        return {"body": self.body, "signature": base64.b64encode(self.signature).decode()}

    @classmethod
    def from_json(cls, value: object) -> "Receipt":
        """Read :meth:`to_json`'s form; :class:`StoreError` for anything else."""
        if not isinstance(value, dict) or set(value) != {"body", "signature"}:
            raise StoreError("a receipt is an object with a body and a signature")
        body, signature = value["body"], value["signature"]
        if not isinstance(body, str) or not isinstance(signature, str) or len(body) > 4096:
            raise StoreError("the body and the signature of a receipt are short texts")
        try:
            return cls(body, base64.b64decode(signature, validate=True))
        except (binascii.Error, ValueError):
            raise StoreError("the signature of a receipt is base64") from None


@dataclass(frozen=True)
class ReceiptKey:
    """What receipts are verified with.

    Attributes
    ----------
    public_key
        32 bytes, Ed25519.
    retired_at
        When it was replaced; None while it is in force, or where nobody says.
    """

    public_key: bytes = field(repr=False)
    retired_at: datetime | None = None

    @property
    def key_id(self) -> str:
        """:func:`key_fingerprint` of it."""
        return key_fingerprint(self.public_key)


class ReceiptSigner:
    """Makes pseudonyms and receipts with the deployment's keys."""

    def __init__(self, secrets: Secrets) -> None:
        self._secrets = secrets

    def prepare(self) -> None:
        """Obtain the keys; to be called before a transaction that needs them."""
        self._secrets.get(SecretName.PSEUDONYM)
        self._secrets.get(SecretName.RECEIPT)

    def pseudonym(self, tenant: str, subject_id: str) -> str:
        """Keyed pseudonym, 64 hexadecimal digits, of one subject of one tenant."""
        return self.pseudonyms(tenant, subject_id)[0]

    def pseudonyms(self, tenant: str, subject_id: str) -> tuple[str, ...]:
        """:meth:`pseudonym`, and behind it those that older lines of the audit log name."""
        digests = self._secrets.get(SecretName.PSEUDONYM).digests(encode_parts(tenant, subject_id))
        return tuple(digest.hex() for digest in digests)

    def keys(self) -> tuple[ReceiptKey, ...]:
        """Keys that verify this deployment's receipts: the one in force, then the retired ones."""
        secret = self._secrets.get(SecretName.RECEIPT)
        retired = (ReceiptKey(public_key_of(key.value), key.at) for key in reversed(secret.retired))
        return ReceiptKey(public_key_of(secret.value)), *retired

    def public_key(self) -> bytes:
        """The 32 bytes that verify the receipts that are signed now."""
        return public_key_of(self._secrets.get(SecretName.RECEIPT).value)

    def sign(self, *, tenant: str, pseudonym: str, erased: Erased, erased_at: datetime) -> Receipt:
        """Write and sign the receipt of a subject, with a random id of its own."""
        return self._signed(
            SUBJECT_KIND,
            erased_at,
            tenant=tenant,
            subject=pseudonym,
            held=erased.contract_id is not None,
            contract_id=erased.contract_id,
            erased=erased.items,
        )

    def sign_tenant(
        self, *, tenant: str, rotation_epoch: int, erased: ErasedTenant, erased_at: datetime
    ) -> Receipt:
        """Write and sign the receipt of a tenant, with a random id of its own."""
        return self._signed(
            TENANT_KIND,
            erased_at,
            tenant=tenant,
            held=True,
            rotation_epoch=rotation_epoch,
            erased=erased.items,
        )

    def _signed(self, kind: str, erased_at: datetime, **claims: Any) -> Receipt:
        head = {
            "kind": kind,
            "version": _VERSION,
            "receipt_id": uuid.uuid4().hex,
            "erased_at": erased_at.isoformat(),
        }
        return sign_claims({**head, **claims}, self._secrets.get(SecretName.RECEIPT).value)


def sign_claims(claims: dict[str, Any], private_key: bytes) -> Receipt:
    """Write the text of a receipt, which names its key, and sign it."""
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
    """Column ``pseudonym`` of a tenant's receipts: no subject's, since those are keyed.

    Not secret: the receipt itself names the tenant.
    """
    return hashlib.sha256(encode_parts("tenant erasure", tenant)).hexdigest()


def keep_receipt(connection: Connection, pseudonym: str, receipt: Receipt, now: datetime) -> None:
    """Store a receipt under a subject's pseudonym, or a :func:`tenant_receipt_name`."""
    connection.execute(
        sa.insert(ReceiptRow).values(
            pseudonym=pseudonym, body=receipt.body, signature=receipt.signature, created_at=now
        )
    )


def latest_receipt(connection: Connection, pseudonym: str) -> Receipt | None:
    """The last receipt that :func:`keep_receipt` stored under a name, or None."""
    row = connection.execute(
        sa.select(ReceiptRow.body, ReceiptRow.signature)
        .where(ReceiptRow.pseudonym == pseudonym)
        .order_by(ReceiptRow.sequence.desc())
        .limit(1)
    ).one_or_none()
    return None if row is None else Receipt(row.body, row.signature)


def verify_receipt(receipt: Receipt, public_key: bytes) -> dict[str, Any]:
    """Check the signature and the form of a subject's or a tenant's receipt; return its claims.

    Raises
    ------
    StoreError
        If it was not signed with this key, was altered, or is no erasure receipt.
    """
    try:
        key = Ed25519PublicKey.from_public_bytes(public_key)
    except ValueError:
        raise StoreError("the public key of a deployment has 32 bytes") from None
    try:
        key.verify(receipt.signature, receipt.body.encode())
    except InvalidSignature:
        raise StoreError(
            "the receipt does not carry this deployment's signature: "
            "it was altered, or another deployment signed it"
        ) from None
    try:
        claims = receipt.claims
    except (ValueError, RecursionError):
        raise StoreError("the receipt's body is not JSON") from None
    if (
        not isinstance(claims, dict)
        or claims.get("kind") not in (SUBJECT_KIND, TENANT_KIND)
        or claims.get("version") != _VERSION
    ):
        raise StoreError("the signed text is not an erasure receipt of version 1")
    return claims


def verify_under(receipt: Receipt, keys: Sequence[ReceiptKey]) -> tuple[dict[str, Any], ReceiptKey]:
    """:func:`verify_receipt` under one of several keys; returns the key too.

    Raises
    ------
    StoreError
        As there, and if the key was retired before the time that the receipt names.
    """
    error = StoreError("a receipt is verified with at least one key")
    for key in keys:
        try:
            claims = verify_receipt(receipt, key.public_key)
        except StoreError as refusal:
            error = refusal
            continue
        if key.retired_at is not None and not _is_before(claims, key.retired_at):
            raise StoreError(
                f"the receipt is dated after its key {key.key_id} was retired: somebody signed it "
                "who took that key"
            )
        return claims, key
    raise error


def _is_before(claims: dict[str, Any], time: datetime) -> bool:
    try:
        return datetime.fromisoformat(claims["erased_at"]) <= time
    except (KeyError, TypeError, ValueError):
        return False
