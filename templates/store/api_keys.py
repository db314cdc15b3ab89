"""API keys: tokens that are shown once, and the rights they carry.

A token is ``vf_<prefix>_<secret>``, 48 and 256 random bits in hexadecimal. The store keeps the
prefix, to find the row, and the SHA-256 of the whole token: a secret of 256 random bits cannot be
guessed from a fast hash. A row carries an HMAC, under a secret of the deployment, over everything
that gives rights: so an attacker who can write the database, but has no master key, can neither
make a key nor widen one. A row whose MAC is wrong is refused.
"""

import contextlib
import functools
import hashlib
import hmac
import logging
import os
import uuid
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
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
_USE_IS_NOTED_EVERY = timedelta(minutes=1)
_NOTE_WAIT_S = 0.1
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
    last_used_at: datetime | None = None
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
        key = ApiKey(
            id=uuid.uuid4().hex,
            prefix=os.urandom(6).hex(),
            tenant=tenant,
            rights=granted,
            label=label,
            created_at=self._context.clock(),
            expires_at=expires_at,
            lowest_level=lowest_level,
        )
        with self._context.database.write() as session:
            return self._insert(session, key, by)

    def verify(self, token: str) -> ApiKey | None:
        """Return the key of a token, or None if it is unknown, wrong, expired or revoked.

        The comparison takes the same time wherever the tokens differ, and an unknown prefix is
        compared too.
        """
        match = TOKEN.fullmatch(token)
        row = self._row(match[1] if match else "")
        expected = _NOBODYS_HASH if row is None else row.token_hash
        same = hmac.compare_digest(_token_hash(token), expected)
        key = self._valid(row) if same else None
        if key is not None:
            self.note_use(key)
        return key

    def valid(self, prefix: str) -> ApiKey | None:
        """Return the key of a prefix if it is good now.

        For what the service itself made under that key: a caller who knows a prefix has no key. So
        the use is not noted: see :meth:`note_use`.
        """
        return self._valid(self._row(prefix))

    def all(self, *, tenant: str | None = None) -> tuple[ApiKey, ...]:
        """Every key, or every key of a tenant, the oldest first."""
        query = _KEYS.order_by(ApiKeyRow.created_at, ApiKeyRow.prefix)
        if tenant is not None:
            query = query.where(TenantRow.name == tenant)
        with self._context.database.read() as session:
            return self.read_all(session, query)

    def read_all(self, session: Session, query: Any = None) -> tuple[ApiKey, ...]:
        """Every key that a query finds, by default every one."""
        with _unreadable_is_altered():
            rows = session.execute(_KEYS if query is None else query).all()
        return tuple(self._read(row) for row in rows)

    def revoke(self, prefix: str, *, by: By = PROGRAM) -> bool:
        """Revoke a key for good; True unless it was unknown or revoked before.

        An unknown prefix does not get into the audit log: it may be a token that was taken for one.
        """
        with self._context.database.write() as session:
            row = session.execute(_OF_PREFIX, {"prefix": prefix}).one_or_none()
            if row is None:
                entry = Entry("key-revoke", "unknown_key", by)
            elif row.revoked_at is not None:
                entry = Entry("key-revoke", "revoked_before", by, row.tenant, detail=prefix)
            else:
                entry = Entry("key-revoke", "revoked", by, row.tenant, detail=prefix)
                self._revoke(session, row)
            self._context.audit_log.append(session, entry)
        return entry.outcome == "revoked"

    def authenticate_again(self, session: Session, secret: bytes) -> tuple[str, ...]:
        """Give every authentic key a MAC under a new secret, in a write.

        Returns the prefixes of the others, which are good for nothing from then on.
        """
        refused = []
        for row in session.execute(_KEYS).all():
            if self._is_authentic(row):
                _update(session, row.id, mac=_mac(secret, row._asdict()))
            else:
                refused.append(row.prefix)
        return tuple(refused)

    def note_use(self, key: ApiKey) -> None:
        """Note that a key is used: to the minute, so that not every request is a write.

        A failure is passed over: a full, busy or read-only database must not refuse a good key.
        """
        now = self._context.clock()
        if key.last_used_at is not None and key.last_used_at > now - _USE_IS_NOTED_EVERY:
            return
        database = self._context.database
        with contextlib.suppress(StoreError), database.write(wait=_NOTE_WAIT_S) as session:
            _update(session, key.id, last_used_at=now)

    def _row(self, prefix: str) -> Any:
        with _unreadable_is_altered(), self._context.database.read() as session:
            return session.execute(_OF_PREFIX, {"prefix": prefix}).one_or_none()

    def _valid(self, row: Any) -> ApiKey | None:
        if row is None:
            return None
        key = self._read(row)
        if not key.authentic:
            _logger.warning(
                "an API key's row is not authentic and was passed over",
                extra={"fields": {"key_id": key.prefix}},
            )
        return key if key.is_valid_at(self._context.clock()) else None

    def _read(self, row: Any) -> ApiKey:
        with _unreadable_is_altered():
            values = {name: row._mapping[name] for name in _FIELDS}
            values["rights"] = _granted(row.rights)
            return ApiKey(**values, authentic=self._is_authentic(row))

    def _is_authentic(self, row: Any) -> bool:
        expected = _mac(self._context.secrets.get(SecretName.API_KEYS), row._mapping)
        return hmac.compare_digest(expected, row.mac)

    def _insert(self, session: Session, key: ApiKey, by: By) -> NewApiKey:
        token = f"vf_{key.prefix}_{os.urandom(32).hex()}"
        row: dict[str, Any] = {
            **{name: getattr(key, name) for name in _FIELDS - {"tenant"}},
            "tenant_id": tenant_of(session, key.tenant).id,
            "token_hash": _token_hash(token),
            "rights": ",".join(sorted(key.rights)),
        }
        secret = self._context.secrets.get(SecretName.API_KEYS)
        row["mac"] = _mac(secret, {**row, "tenant": key.tenant})
        session.add(ApiKeyRow(**row))
        entry = Entry("key-create", "created", by, key.tenant, detail=key.prefix)
        self._context.audit_log.append(session, entry)
        return NewApiKey(key=key, token=token)

    def _revoke(self, session: Session, row: Any) -> None:
        """Note the moment in a row; one that is not authentic stays so."""
        columns: dict[str, Any] = {"revoked_at": self._context.clock()}
        if self._is_authentic(row):
            secret = self._context.secrets.get(SecretName.API_KEYS)
            columns["mac"] = _mac(secret, {**row._mapping, **columns})
        _update(session, row.id, **columns)


_AUTHENTICATED = (
    "id",
    "tenant_id",
    "tenant",
    "prefix",
    "token_hash",
    "rights",
    "expires_at",
    "revoked_at",
    "lowest_level",
)
"""What the MAC of a row covers; `tenant` is the name, which the tenant's own row could change."""
_FIELDS = set(ApiKey.__dataclass_fields__) - {"authentic"}
_KEYS: Any = sa.select(
    *(column for column in ApiKeyRow.__table__.columns),
    TenantRow.name.label("tenant"),
).join(TenantRow, TenantRow.id == ApiKeyRow.tenant_id)
_OF_PREFIX = _KEYS.where(ApiKeyRow.prefix == sa.bindparam("prefix"))


@contextlib.contextmanager
def _unreadable_is_altered() -> Iterator[None]:
    # SQLite keeps any value in any column.
    try:
        yield
    except (ValueError, TypeError):
        raise StoreError(
            "a row of the API keys was altered: run `veilface audit-log verify`"
        ) from None


def _update(session: Session, key_id: str, **columns: Any) -> None:
    session.execute(sa.update(ApiKeyRow).where(ApiKeyRow.id == key_id).values(columns))


def _mac(secret: bytes, values: Mapping[str, Any]) -> bytes:
    parts = [_part(values[name]) for name in _AUTHENTICATED]
    return hmac.digest(secret, encode_parts("api key", *parts), hashlib.sha256)


def _part(value: object) -> str | bytes | int:
    match value:
        case datetime():
            return value.astimezone(UTC).isoformat(timespec="microseconds")
        case str() | bytes():
            return value
        case _:
            return 0  # NULL; no column that may be NULL holds a number


@functools.lru_cache(maxsize=256)
def _granted(rights: str) -> frozenset[Right]:
    return frozenset(right for right in Right if right in rights.split(","))


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
