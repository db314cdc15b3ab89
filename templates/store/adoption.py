"""Authenticating the rows of a database from before rows carried a MAC, once.

It is done at the upgrade of the schema and never again: the head of the audit log gets another MAC
with it, and says from then on that a row without one was made, or stripped, by somebody else. What
the rows say at this moment is taken as true, except for an API key that the audit log contradicts:
one that it does not know, knows in another tenant or as revoked stays without a MAC, and is good
for nothing.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.audit_chain import Line, LineKeys, is_true_line
from templates.store.audit_log import PROGRAM, AuditLog, Entry
from templates.store.authenticity import (
    LAST_KEY_LINE,
    LAST_TENANT_LINE,
    TENANT_OF_KEY,
    columns_of,
    row_mac,
    warn,
)
from templates.store.context import StoreContext
from templates.store.schema import (
    ATTEMPT_LINES,
    KEY_LINES,
    ApiKeyRow,
    AuditRow,
    Base,
    FailedAttemptsRow,
    IdempotencyRow,
    TenantRow,
)


@dataclass(frozen=True)
class Adoption:
    """What :func:`adopt` did.

    Attributes
    ----------
    rows
        Rows that were authenticated.
    refused
        Prefixes of the API keys that the audit log contradicts.
    """

    rows: int = 0
    refused: tuple[str, ...] = ()


def adopt(context: StoreContext) -> Adoption:
    """Authenticate the rows there are, if this database's never were.

    In one transaction, while no other write runs.

    Raises
    ------
    BrokenAuditLog
        If the key of the audit log is gone.
    """
    audit_log = context.audit_log
    if context.read(audit_log.authenticates_rows):
        return Adoption()
    return context.write_alone(lambda connection: _adopt(connection, audit_log))


def _adopt(connection: Connection, audit_log: AuditLog) -> Adoption:
    if not audit_log.begin_authentication(connection):
        return Adoption()
    refused = tuple(contradicted_keys(connection, audit_log.line_keys()))
    for prefix in refused:
        warn("an API key that the audit log contradicts was not authenticated", key_id=prefix)
    rows = sum(
        _authenticate(connection, audit_log.row_key(), table, line, authentic)
        for table, line, authentic in (
            (TenantRow, LAST_TENANT_LINE, sa.true()),
            (ApiKeyRow, LAST_KEY_LINE, ApiKeyRow.prefix.not_in(refused)),
            (FailedAttemptsRow, _LAST_ATTEMPT_LINE, sa.true()),
            (IdempotencyRow, None, IdempotencyRow.status.is_not(None)),
        )
    )
    if rows:
        entry = Entry("db-upgrade", "authenticated", PROGRAM, detail=f"{rows} rows")
        audit_log.append(connection, entry)
    return Adoption(rows, refused)


def _authenticate(
    connection: Connection,
    key: bytes,
    table: type[Base],
    last_line: sa.ScalarSelect[Any] | None,
    which: sa.ColumnElement[bool],
) -> int:
    rows = cast(sa.Table, table.__table__)
    columns = [column for column in columns_of(table) if column.key not in ("line", "mac")]
    if table is ApiKeyRow:
        columns.append(TENANT_OF_KEY.label("tenant"))
    line = sa.literal(0) if last_line is None else sa.func.coalesce(last_line, 0)
    query = sa.select(*columns, line.label("line")).where(which)
    statement = sa.update(rows).where(
        *(column == sa.bindparam(f"of_{column.key}") for column in rows.primary_key)
    )
    # Read whole before it is written: a cursor over rows that change meanwhile is not defined.
    before = [row._asdict() for row in connection.execute(query)]
    for values in before:
        changed = {"mac": row_mac(key, table, values)}
        if last_line is not None:
            changed["line"] = values["line"]
        whose = {f"of_{column.key}": values[column.key] for column in rows.primary_key}
        connection.execute(statement, {**whose, **changed})
    return len(before)


def contradicted_keys(connection: Connection, line_keys: LineKeys) -> Iterator[str]:
    """Prefixes of the keys that the audit log does not know, or knows otherwise."""
    keys = sa.select(ApiKeyRow.prefix, ApiKeyRow.revoked_at, TenantRow.name.label("tenant"))
    query = keys.outerjoin(TenantRow, TenantRow.id == ApiKeyRow.tenant_id)
    for key in connection.execute(query.order_by(ApiKeyRow.prefix)).all():
        lines = [
            line
            for row in connection.execute(_LINES_OF_KEY, {"prefix": key.prefix})
            if is_true_line(line_keys, line := Line(**row._mapping))
        ]
        created = any((line.action, line.tenant) == ("key-create", key.tenant) for line in lines)
        revoked = any((line.action, line.outcome) == ("key-revoke", "revoked") for line in lines)
        if not created or (revoked and key.revoked_at is None):
            yield key.prefix


_LINES_OF_KEY: Any = sa.select(
    *(getattr(AuditRow, name) for name in Line.__dataclass_fields__)
).where(AuditRow.detail == sa.bindparam("prefix"), KEY_LINES)
_LAST_ATTEMPT_LINE = (
    sa.select(sa.func.max(AuditRow.sequence))
    .where(AuditRow.pseudonym == FailedAttemptsRow.pseudonym, ATTEMPT_LINES)
    .correlate(FailedAttemptsRow)
    .scalar_subquery()
)
