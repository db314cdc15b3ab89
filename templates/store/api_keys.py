"""API keys: tokens that are shown once, and the rights they carry.

A token is ``vf_<prefix>_<secret>``, 48 and 256 random bits in hexadecimal. The store keeps the
prefix, to find the row, and the SHA-256 of the whole token: a secret of 256 random bits cannot be
guessed from a fast hash.
"""

import contextlib
import functools
import hashlib
import hmac
import os
import uuid
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.contract.levels import LEVEL_NAME
from templates.errors import StoreError, StoreUnavailable
from templates.keys.api_token import TOKEN
from templates.store.audit_log import PROGRAM, TENANT_ERASE, By, Entry
from templates.store.authenticity import LAST_KEY_LINE, columns_of, is_current, row_mac, warn
from templates.store.context import StoreContext
from templates.store.schema import ApiKeyRow, AuditRow, TenantRow
from templates.store.subject_rows import tenant_id_of
from templates.store.tenants import Tenants

MAX_LABEL = 128

_NOBODYS_HASH = os.urandom(32)
_USE_IS_NOTED_EVERY = timedelta(minutes=1)


class Right(StrEnum):
    """What a key may do."""

    ENROLL = "enroll"
    VERIFY = "verify"
    ERASE = "erase"
    EXPORT = "export"
    SCORES = "scores"
    EMBEDDINGS = "embeddings"
    ADMIN = "admin"


@dataclass(frozen=True)
class ApiKey:
    """An API key without its secret.

    Attributes
    ----------
    lowest_level
        Security level below which it does not verify; None for any.
    authentic
        Whether its row is as this program left it. Else it is as good as none.
    """

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


@dataclass(frozen=True)
class _Grant:
    """What a key that is made is good for."""

    tenant: str
    rights: frozenset[Right]
    label: str
    expires_at: datetime | None = None
    lowest_level: str | None = None


class ApiKeys:
    """Repository of API keys."""

    def __init__(self, context: StoreContext, tenants: Tenants) -> None:
        self._context = context
        self._tenants = tenants

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

        Raises
        ------
        UnknownTenant, StoreError
            For no right at all, an unknown one, or a label that is too long.
        """
        granted = _rights(rights)
        if len(label) > MAX_LABEL or not label.isprintable():
            raise StoreError(f"a label has at most {MAX_LABEL} printable characters")
        if lowest_level is not None and not LEVEL_NAME.fullmatch(lowest_level):
            raise StoreError("the lowest level of a key is the name of a level, such as fmr-1e-4")
        grant = _Grant(tenant, granted, label, expires_at, lowest_level)
        return self._context.write(lambda connection: self._insert(connection, grant, by))

    def bootstrap(
        self,
        *,
        tenant: str = "default",
        rights: Iterable[Right] = tuple(Right),
        by: By = PROGRAM,
    ) -> NewApiKey | None:
        """Make the first tenant and the first key, once in the life of a store.

        Of any number of processes that call this at once, one gets the key and the others None.
        """
        granted = _rights(rights)

        def work(connection: Connection) -> NewApiKey | None:
            if _had_keys(connection):
                return None
            self._tenants.ensure(connection, tenant)
            return self._insert(connection, _Grant(tenant, granted, "bootstrap"), by)

        return self._context.write(work, lock="bootstrap")

    def verify(self, token: str) -> ApiKey | None:
        """Return the key of a token, or None if it is unknown, wrong, expired or revoked.

        A key whose row is not authentic is as good as unknown. The comparison
        takes the same time wherever the tokens differ, and an unknown prefix is compared too.
        """
        match = TOKEN.fullmatch(token)
        prefix = match[1] if match else ""
        try:
            row = self._row(prefix)
        except (ValueError, TypeError):
            # SQLite keeps any value in any column.
            warn("an API key's row is not authentic and was passed over", key_id=prefix)
            return None
        expected = _NOBODYS_HASH if row is None else row.token_hash
        same = hmac.compare_digest(_token_hash(token), expected)
        key = self._valid(row) if same else None
        if key is not None:
            self.note_use(key)
        return key

    def valid(self, prefix: str) -> ApiKey | None:
        """Return the key of a prefix, or None where :meth:`verify` would return none.

        For what the service itself made under that key: whoever knows a prefix has no key. So the
        use is not noted: see :meth:`note_use`.
        """
        try:
            row = self._row(prefix)
        except (ValueError, TypeError):
            warn("an API key's row is not authentic and was passed over", key_id=prefix)
            return None
        return self._valid(row)

    def _valid(self, row: Any) -> ApiKey | None:
        """Return the key of a row if it is good now."""
        if row is None:
            return None
        key, now = self._read(row), self._context.clock()
        if not key.authentic:
            warn("an API key's row is not authentic and was passed over", key_id=key.prefix)
        return key if key.is_valid_at(now) else None

    def get(self, prefix: str) -> ApiKey | None:
        """Return a key by its prefix, or None."""
        row = self._row(prefix)
        return None if row is None else self._read(row)

    def all(self, *, tenant: str | None = None) -> tuple[ApiKey, ...]:
        """Every key, or every key of a tenant, the oldest first."""
        query = _KEYS.order_by(ApiKeyRow.created_at, ApiKeyRow.prefix)
        if tenant is not None:
            query = query.where(TenantRow.name == tenant)
        rows = self._context.read(lambda connection: connection.execute(query).all())
        return tuple(self._read(row) for row in rows)

    def revoke(self, prefix: str, *, by: By = PROGRAM) -> bool:
        """Revoke a key for good; True unless it was unknown or revoked before.

        An unknown prefix does not get into the audit log: it may be a token that was taken for one.
        """

        def work(connection: Connection) -> bool:
            row = connection.execute(_LOCKED, {"prefix": prefix}).one_or_none()
            if row is None:
                entry = Entry("key-revoke", "unknown_key", by)
                self._context.audit_log.append(connection, entry)
                return False
            revoked = row.revoked_at is None
            outcome = "revoked" if revoked else "revoked_before"
            self._change(
                connection,
                row,
                Entry("key-revoke", outcome, by, row.tenant, detail=prefix),
                revoked_at=self._context.clock() if revoked else row.revoked_at,
            )
            return revoked

        return self._context.write(work)

    def revoke_all(self, connection: Connection, tenant: str, *, by: By) -> None:
        """Revoke every key of a tenant inside a transaction that is open already."""
        query = _KEYS.where(TenantRow.name == tenant, ApiKeyRow.revoked_at.is_(None))
        rows = connection.execute(query.order_by(ApiKeyRow.id).with_for_update(of=ApiKeyRow)).all()
        now = self._context.clock()
        for row in rows:
            entry = Entry("key-revoke", "revoked", by, tenant, detail=row.prefix)
            self._change(connection, row, entry, revoked_at=now)

    def replace(self, prefix: str, *, grace: timedelta, by: By = PROGRAM) -> NewApiKey | None:
        """Make a key in place of another one, which stays valid for a while.

        The new key has the tenant, rights, label, expiry and lowest level of the old one,
        so replacing a key does not prolong or widen what was granted.

        Parameters
        ----------
        prefix
            Of the key that goes.
        grace
            How long it stays valid, for its users to change over; never longer than before.
        by
            Who asks for it, for the audit log.

        Returns
        -------
        NewApiKey or None
            None if there is no valid key of this prefix.
        """
        if grace < timedelta(0):
            raise StoreError("the time that an old key stays valid is nothing or more")

        def work(connection: Connection) -> NewApiKey | None:
            now = self._context.clock()
            row = connection.execute(_LOCKED, {"prefix": prefix}).one_or_none()
            old = None if row is None else self._read(row)
            if old is None or not old.is_valid_at(now):
                return None
            grant = _Grant(**{name: getattr(old, name) for name in _Grant.__dataclass_fields__})
            new = self._insert(connection, grant, by)
            self._change(
                connection,
                row,
                Entry("key-replace", "replaced", by, old.tenant, detail=prefix),
                expires_at=_sooner(old.expires_at, now, grace),
            )
            return new

        return self._context.write(work)

    def _row(self, prefix: str) -> Any:
        return self._context.read(
            lambda connection: connection.execute(_OF_PREFIX, {"prefix": prefix}).one_or_none()
        )

    def _insert(self, connection: Connection, grant: "_Grant", by: By) -> NewApiKey:
        tenant_id = tenant_id_of(connection, grant.tenant)
        key_id, prefix = uuid.uuid4().hex, os.urandom(6).hex()
        key = ApiKey(id=key_id, prefix=prefix, created_at=self._context.clock(), **vars(grant))
        token = f"vf_{prefix}_{os.urandom(32).hex()}"
        entry = Entry("key-create", "created", by, key.tenant, detail=prefix)
        row: dict[str, Any] = {
            "id": key_id,
            "tenant_id": tenant_id,
            "prefix": prefix,
            "token_hash": _token_hash(token),
            "rights": ",".join(sorted(key.rights)),
            "label": key.label,
            "created_at": key.created_at,
            "expires_at": key.expires_at,
            "revoked_at": None,
            "lowest_level": key.lowest_level,
            "line": self._context.audit_log.append(connection, entry),
        }
        row_key = self._context.audit_log.row_key()
        row["mac"] = row_mac(row_key, ApiKeyRow, {**row, "tenant": key.tenant})
        connection.execute(sa.insert(ApiKeyRow).values(row))
        return NewApiKey(key=key, token=token)

    def _change(self, connection: Connection, row: Any, entry: Entry, **columns: object) -> None:
        """Change columns of a row that is locked, and add the line that tells of it.

        A row that is not authentic stays so: whatever else it holds must not be vouched for.
        """
        authentic = self._is_authentic(row)
        columns["line"] = self._context.audit_log.append(connection, entry)
        if authentic:
            row_key = self._context.audit_log.row_key()
            columns["mac"] = row_mac(row_key, ApiKeyRow, {**row._mapping, **columns})
        statement = sa.update(ApiKeyRow).where(ApiKeyRow.prefix == row.prefix)
        connection.execute(statement.values(columns))

    def _is_authentic(self, row: Any) -> bool:
        return is_current(self._context.audit_log.row_key(), ApiKeyRow, row._mapping)

    def _read(self, row: Any) -> ApiKey:
        values = {name: row._mapping[name] for name in _KEY_COLUMNS}
        values["rights"] = _granted(row.rights)
        return ApiKey(**values, authentic=self._is_authentic(row))

    def note_use(self, key: ApiKey) -> None:
        """Note that a key is used: to the minute, so that not every request is a write."""
        now = self._context.clock()
        due = now - _USE_IS_NOTED_EVERY
        if key.last_used_at is not None and key.last_used_at > due:
            return
        statement = (
            sa.update(ApiKeyRow)
            .where(
                ApiKeyRow.id == key.id,
                sa.or_(ApiKeyRow.last_used_at.is_(None), ApiKeyRow.last_used_at <= due),
            )
            .values(last_used_at=now)
        )
        # A full or busy disk must not refuse a good key.
        with contextlib.suppress(StoreUnavailable):
            self._context.database.write(lambda connection: connection.execute(statement))


_KEY_COLUMNS = set(ApiKey.__dataclass_fields__) - {"authentic"}
_KEYS: Any = sa.select(
    *columns_of(ApiKeyRow),
    TenantRow.name.label("tenant"),
    LAST_KEY_LINE.label("last_line"),
    ApiKeyRow.last_used_at,
).join(TenantRow, TenantRow.id == ApiKeyRow.tenant_id)
_OF_PREFIX = _KEYS.where(ApiKeyRow.prefix == sa.bindparam("prefix"))
_LOCKED = _OF_PREFIX.with_for_update(of=ApiKeyRow)


def _had_keys(connection: Connection) -> bool:
    """Whether there are keys, or were some that went with their tenant."""
    keys = sa.select(ApiKeyRow.id).limit(1)
    erased = sa.select(AuditRow.sequence).where(AuditRow.action == TENANT_ERASE).limit(1)
    return any(connection.execute(query).first() is not None for query in (keys, erased))


def _sooner(expires_at: datetime | None, now: datetime, grace: timedelta) -> datetime | None:
    """When a key expires that has only so long left, and not longer than it had."""
    try:
        limit = now + grace
    except OverflowError:
        return expires_at
    return limit if expires_at is None else min(expires_at, limit)


@functools.lru_cache(maxsize=256)
def _granted(rights: str) -> frozenset[Right]:
    """Rights of a row; those that there are, in one that somebody else wrote."""
    return frozenset(right for right in Right if right in str(rights).split(","))


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
