"""The rows of the audit log as they are stored, in a form in which an altered one still arrives.

SQLite keeps any value in any column, and PostgreSQL knows times that Python does not. Read as
their types they would end the verification instead of failing it.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.audit_chain import Anchor, Line
from templates.store.schema import TENANT_LINES, AuditHeadRow, AuditRow


class LogEnd(NamedTuple):
    """What the database holds in one moment, seen from the last line that was read."""

    head: Anchor | None
    mac: bytes
    held: int  # lines up to that one
    more: bool  # whether there are lines after it


def read_end(connection: Connection, *, after: int | None) -> LogEnd:
    """What the log holds up to a line, and its head, in one query."""
    before, later = _sides(after)
    # With a limit: PostgreSQL refuses a subquery of two rows, and this must find them.
    head = [
        sa.select(column).limit(1).scalar_subquery().label(column.key)
        for column in _head_columns(connection.dialect.name)
    ]
    heads = sa.select(sa.func.count()).select_from(AuditHeadRow).scalar_subquery()
    held = sa.select(sa.func.count()).select_from(AuditRow).where(before).scalar_subquery()
    more = sa.exists().where(later)
    row = connection.execute(
        sa.select(heads.label("heads"), held.label("held"), more.label("more"), *head)
    ).one()
    return LogEnd(*_head_of([row] if row.heads == 1 else []), row.held, row.more)


def read_head(connection: Connection, *, for_update: bool = False) -> tuple[Anchor | None, bytes]:
    """The head and its MAC; None where there is not one row, or a column lost its value."""
    return _head_of(connection.execute(_head_query(connection.dialect.name, for_update)).all())


def _head_of(rows: Sequence[Any]) -> tuple[Anchor | None, bytes]:
    if len(rows) != 1 or rows[0].sequence is None or rows[0].hash is None:
        return None, b""
    return Anchor(rows[0].sequence, rows[0].hash), rows[0].mac or b""


def read_lines(connection: Connection, *, after: int | None, batch: int) -> Sequence[Any]:
    """The next lines after one, as :meth:`Line.read` takes them."""
    _, later = _sides(after)
    query = sa.select(*_line_columns(connection))
    return connection.execute(query.where(later).order_by(AuditRow.sequence).limit(batch)).all()


def read_tenant_lines(
    connection: Connection,
    tenant: str,
    pseudonyms: Sequence[str],
    *,
    above: int,
    before: int,
    limit: int,
) -> Sequence[Any]:
    """A tenant's lines between two numbers, the latest first; on subjects, only on `pseudonyms`."""
    query = sa.select(*_line_columns(connection)).where(
        AuditRow.tenant == tenant, AuditRow.sequence > above, AuditRow.sequence < before
    )
    if pseudonyms:
        query = query.where(AuditRow.pseudonym.in_(pseudonyms))
    return connection.execute(query.order_by(AuditRow.sequence.desc()).limit(limit)).all()


def read_tenant_erasures(connection: Connection, tenant: str, *, through: int) -> Iterator[Any]:
    """Lines that tell of the tenant's erasures, up to a number, the latest first."""
    query = sa.select(*_line_columns(connection)).where(
        AuditRow.tenant == tenant,
        AuditRow.outcome == "erased",
        AuditRow.action == "tenant-erase",
        TENANT_LINES,  # which has an index
        AuditRow.sequence <= through,
    )
    yield from connection.execute(query.order_by(AuditRow.sequence.desc()))


def _sides(after: int | None) -> tuple[sa.ColumnElement[bool], sa.ColumnElement[bool]]:
    # Without a bound first: a line that was slipped in may have any number.
    if after is None:
        return sa.false(), AuditRow.sequence.is_not(None)
    return AuditRow.sequence <= after, AuditRow.sequence > after


def _line_columns(connection: Connection) -> list[Any]:
    columns = [getattr(AuditRow, name) for name in Line.__dataclass_fields__]
    if connection.dialect.name == "sqlite":
        return [
            column if column is AuditRow.sequence else _raw(column).label(column.key)
            for column in columns
        ]
    utc = sa.func.to_char(sa.func.timezone("UTC", AuditRow.at), "YYYY-MM-DD HH24:MI:SS.US")
    return [utc.label("at") if column is AuditRow.at else column for column in columns]


@functools.cache
def _head_query(dialect: str, for_update: bool) -> "sa.Select[*tuple[Any, ...]]":
    query = sa.select(*_head_columns(dialect))
    return query.with_for_update() if for_update else query


def _head_columns(dialect: str) -> list[Any]:
    columns: list[Any] = [AuditHeadRow.hash, AuditHeadRow.mac]
    if dialect == "sqlite":
        sequence = sa.cast(AuditHeadRow.sequence, sa.Integer).label("sequence")
        return [sequence, *(_raw(column).label(column.key) for column in columns)]
    return [AuditHeadRow.sequence, *columns]


def _raw(column: Any) -> sa.ColumnElement[Any]:
    return sa.type_coerce(sa.cast(column, sa.LargeBinary), sa.types.NullType())
