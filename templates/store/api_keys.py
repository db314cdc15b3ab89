"""API keys: tokens that are shown once, and the rights they carry.

A token is ``vf_<prefix>_<secret>``, 48 and 256 random bits in hexadecimal. The store keeps the
prefix, to find the row, and the SHA-256 of the whole token: a secret of 256 random bits cannot be
guessed from a fast hash. A row carries an HMAC, under a secret of the deployment, over everything
that gives rights: so an attacker who can write the database, but has no master key, can neither
make a key nor widen one. A row whose MAC is wrong is refused.
"""

import hashlib
import hmac
import logging
import os
import uuid
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.contract.levels import LEVEL_NAME
from templates.errors import StoreError
from templates.keys.api_token import TOKEN
from templates.keys.sealing import encode_parts
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.schema import ApiKeyRow, TenantRow
from templates.store.secrets import SecretName
from templates.store.tenants import tenant_of

MAX_LABEL = 128

_NOBODYS_HASH = os.urandom(32)
_logger = logging.getLogger("veilface.store")


class Right(StrEnum):
    """What a key may do."""

    ENROLL = "enroll"
    VERIFY = "verify"
    ERASE = "erase"
    EXPORT = "export"
    SCORES = "scores"
    EMBEDDINGS = "embeddings"
    METRICS = "metrics"
    ADMIN = "admin"


@dataclass(frozen=True)
class ApiKey:
    """An API key without its secret; `authentic` is whether the MAC of its row is good."""

    id: str
    prefix: str
    tenant: str
    rights: frozenset[Right]
    label: str
    created_at: datetime
    expires_at: datetime | None = None
    revoked_at: datetime | None = None
    lowest_level: str | None = None
    authentic: bool = True

    def is_valid_at(self, time: datetime) -> bool:
        """Whether the key is authentic, and neither revoked nor expired."""
        in_time = self.expires_at is None or time < self.expires_at
        return self.authentic and self.revoked_at is None and in_time


@dataclass(frozen=True)
class NewApiKey:
    """A key that was just made; the only moment at which its token exists."""

    key: ApiKey
    token: str = field(repr=False)


class ApiKeys:
    """Repository of API keys."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def create(
        self,
        tenant: str,
        rights: Iterable[Right | str],
        *,
        label: str = "",
        expires_at: datetime | None = None,
        lowest_level: str | None = None,
        by: By = PROGRAM,
    ) -> NewApiKey:
        """Make a key of an existing tenant; the audit log names it by its prefix.

        `lowest_level` is the name of a security level, of whatever contract is served.
        """
        granted = _rights(rights)
        if len(label) > MAX_LABEL or not label.isprintable():
            raise StoreError(f"a label has at most {MAX_LABEL} printable characters")
        if lowest_level is not None and not LEVEL_NAME.fullmatch(lowest_level):
            raise StoreError("the lowest level of a key is the name of a level, such as fmr-1e-4")
        prefix = os.urandom(6).hex()
        token = f"vf_{prefix}_{os.urandom(32).hex()}"
        with self._context.database.write() as session:
            row = ApiKeyRow(
                id=uuid.uuid4().hex,
                tenant_id=tenant_of(session, tenant).id,
                prefix=prefix,
                token_hash=_token_hash(token),
                rights=",".join(sorted(granted)),
                label=label,
                created_at=self._context.clock(),
                expires_at=expires_at,
                lowest_level=lowest_level,
            )
            row.mac = _mac(self._secret, row, tenant)
            session.add(row)
            entry = Entry("key-create", "created", by, tenant, detail=prefix)
            self._context.audit_log.append(session, entry)
            return NewApiKey(self._read(row, tenant), token)

    def verify(self, token: str) -> ApiKey | None:
        """Return the key of a token, or None if it is unknown, wrong, expired or revoked.

        The comparison takes the same time wherever the tokens differ, and an unknown prefix is
        compared too.
        """
        match = TOKEN.fullmatch(token)
        row, tenant = self._row(match[1] if match else "")
        expected = _NOBODYS_HASH if row is None else row.token_hash
        same = hmac.compare_digest(_token_hash(token), expected)
        return self._valid(row, tenant) if same else None

    def valid(self, prefix: str) -> ApiKey | None:
        """Return the key of a prefix if it is good now.

        For what the service itself made under that key: a caller who knows a prefix has no key.
        """
        return self._valid(*self._row(prefix))

    def all(self, *, tenant: str | None = None) -> tuple[ApiKey, ...]:
        """Every key, or every key of a tenant, the oldest first."""
        query = _KEYS.order_by(ApiKeyRow.created_at, ApiKeyRow.prefix)
        if tenant is not None:
            query = query.where(TenantRow.name == tenant)
        with self._context.database.read() as session:
            return self.read_all(session, query)

    def read_all(self, session: Session, query: Any = None) -> tuple[ApiKey, ...]:
        """Every key that a query finds, by default every one."""
        rows = session.execute(_KEYS if query is None else query).all()
        return tuple(self._read(row, tenant) for row, tenant in rows)

    def revoke(self, prefix: str, *, by: By = PROGRAM) -> bool:
        """Revoke a key for good; True unless it was unknown or revoked before.

        An unknown prefix does not get into the audit log: it may be a token that was taken for one.
        """
        with self._context.database.write() as session:
            row, tenant = session.execute(_OF_PREFIX, {"prefix": prefix}).one_or_none() or NOBODY
            if row is None:
                entry = Entry("key-revoke", "unknown_key", by)
            elif row.revoked_at is not None:
                entry = Entry("key-revoke", "revoked_before", by, tenant, detail=prefix)
            else:
                entry = Entry("key-revoke", "revoked", by, tenant, detail=prefix)
                is_authentic = self._is_authentic(row, tenant)
                row.revoked_at = self._context.clock()
                if is_authentic:
                    row.mac = _mac(self._secret, row, tenant)
            self._context.audit_log.append(session, entry)
        return entry.outcome == "revoked"

    def authenticate_again(self, session: Session, secret: bytes) -> tuple[str, ...]:
        """Give every authentic key a MAC under a new secret, in a write.

        Returns the prefixes of the others, which are good for nothing from then on.
        """
        refused = []
        for row, tenant in session.execute(_KEYS).all():
            if self._is_authentic(row, tenant):
                row.mac = _mac(secret, row, tenant)
            else:
                refused.append(row.prefix)
        return tuple(refused)

    @property
    def _secret(self) -> bytes:
        return self._context.secrets.get(SecretName.API_KEYS)

    def _row(self, prefix: str) -> Any:
        """The row of a prefix and the name of its tenant, or nobody's."""
        with self._context.database.read() as session:
            return session.execute(_OF_PREFIX, {"prefix": prefix}).one_or_none() or NOBODY

    def _valid(self, row: ApiKeyRow | None, tenant: str) -> ApiKey | None:
        if row is None:
            return None
        key = self._read(row, tenant)
        if not key.authentic:
            _logger.warning(
                "an API key's row is not authentic and was passed over",
                extra={"fields": {"key_id": key.prefix}},
            )
        return key if key.is_valid_at(self._context.clock()) else None

    def _read(self, row: ApiKeyRow, tenant: str) -> ApiKey:
        try:
            return ApiKey(
                id=row.id,
                prefix=row.prefix,
                tenant=tenant,
                rights=frozenset(right for right in Right if right in row.rights.split(",")),
                label=row.label,
                created_at=row.created_at,
                expires_at=row.expires_at,
                revoked_at=row.revoked_at,
                lowest_level=row.lowest_level,
                authentic=self._is_authentic(row, tenant),
            )
        except (ValueError, TypeError):  # SQLite keeps any value in a column of text
            raise StoreError(
                "a row of the API keys was altered: run `veilface audit-log verify`"
            ) from None

    def _is_authentic(self, row: ApiKeyRow, tenant: str) -> bool:
        return hmac.compare_digest(_mac(self._secret, row, tenant), row.mac)


NOBODY = (None, "")
_KEYS: Any = sa.select(ApiKeyRow, TenantRow.name).join(TenantRow)
_OF_PREFIX = _KEYS.where(ApiKeyRow.prefix == sa.bindparam("prefix"))


def _mac(secret: bytes, row: ApiKeyRow, tenant: str) -> bytes:
    """MAC of all that gives rights, the tenant's name included, which its own row could change."""
    ends = row.expires_at, row.revoked_at
    values = (
        row.id,
        row.tenant_id,
        tenant,
        row.prefix,
        row.token_hash,
        row.rights,
        *(None if at is None else at.astimezone(UTC).isoformat() for at in ends),
        row.lowest_level,
    )
    # No column that may be NULL holds a number, so 0 cannot be taken for one.
    parts = (0 if value is None else value for value in values)
    return hmac.digest(secret, encode_parts("api key", *parts), hashlib.sha256)


def _rights(rights: Iterable[Right | str]) -> frozenset[Right]:
    try:
        granted = frozenset(Right(right) for right in rights)
    except ValueError:
        raise StoreError(f"the rights of a key are among {', '.join(Right)}") from None
    if not granted:
        raise StoreError("a key needs at least one right")
    return granted


def _token_hash(token: str) -> bytes:
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).digest()
