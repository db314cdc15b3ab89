"""Whether the rows that decide are what the audit log tells of.

``templates.store.audit_chain`` finds what was done to the log; this finds what was done beside it,
by somebody who can write the database and has no key. The service passes over such rows, so this
names what it would not: that somebody tried.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.authenticity import (
    LAST_KEY_LINE,
    LAST_TENANT_LINE,
    TENANT_OF_KEY,
    columns_of,
    is_authentic,
    is_current,
)
from templates.store.context import StoreContext
from templates.store.schema import (
    ATTEMPT_LINES,
    KEY_LINES,
    NONCE_LINES,
    TENANT_LINES,
    ApiKeyRow,
    AuditRow,
    Base,
    FailedAttemptsRow,
    TenantRow,
)
from templates.store.secret import Secret, SecretName, digest_again
from templates.store.standing import UNKNOWN_RETENTION

TENANT_ALTERED = "row of a tenant was altered, or put back to an earlier state"
KEY_ALTERED = "row of an API key was made up, altered, or put back to an earlier state"
KEY_NEVER_CREATED = "API key that was never created"
ACTOR_NEVER_CREATED = "actor of audit lines whose key was never created"
COUNT_ALTERED = "count of failed attempts was altered"
COUNT_VANISHED = "count of failed attempts was removed, or put back to an earlier state"
NONCE_TWICE = "nonce that was used up by more than one decision"

MAX_PROBLEMS = 1000
BATCH = 1000


@dataclass(frozen=True)
class RecordProblem:
    """Something in a table that the audit log does not tell of.

    Attributes
    ----------
    what
        A text, one of those of this module.
    about
        Name of the tenant, ``key:`` and the prefix, pseudonym of the subject, or the number of
        the second line.
    """

    what: str
    about: str


def check_records(context: StoreContext) -> tuple[RecordProblem, ...]:
    """Hold the rows that decide against the audit log, beside a service in use.

    Whether the log itself is whole is another question. Counts of failures that had their time are
    removed rightly.

    Returns
    -------
    tuple of RecordProblem
        The first thousand.
    """
    now = context.clock()

    def work(connection: Connection) -> tuple[RecordProblem, ...]:
        return tuple(itertools.islice(_problems(connection, context, now), MAX_PROBLEMS))

    return context.read(work)


def _problems(
    connection: Connection, context: StoreContext, now: datetime
) -> Iterator[RecordProblem]:
    key = context.audit_log.row_key()
    for row in _rows(connection, TenantRow, LAST_TENANT_LINE):
        if not is_current(key, TenantRow, row):
            yield RecordProblem(TENANT_ALTERED, str(row["name"]))
    for row in _rows(connection, ApiKeyRow, LAST_KEY_LINE):
        if row["last_line"] is None:
            yield RecordProblem(KEY_NEVER_CREATED, f"key:{row['prefix']}")
        elif not is_current(key, ApiKeyRow, row):
            yield RecordProblem(KEY_ALTERED, f"key:{row['prefix']}")
    for (actor,) in connection.execute(_ACTORS_WITHOUT_KEY):
        yield RecordProblem(ACTOR_NEVER_CREATED, actor)
    for row in _rows(connection, FailedAttemptsRow, None):
        if not is_authentic(key, FailedAttemptsRow, row):
            yield RecordProblem(COUNT_ALTERED, row["pseudonym"])
    since = {"since": now - UNKNOWN_RETENTION}
    pseudonyms = context.secrets.get(SecretName.PSEUDONYM)
    for pseudonym, line in connection.execute(_VANISHED, since).all():
        if not _is_carried_on(connection, pseudonyms, pseudonym, line):
            yield RecordProblem(COUNT_VANISHED, pseudonym)
    for (sequence,) in connection.execute(_NONCES_TWICE):
        yield RecordProblem(NONCE_TWICE, f"line {sequence}")


def _is_carried_on(connection: Connection, pseudonyms: Secret, pseudonym: str, line: int) -> bool:
    """Whether a count is kept, or the log goes on, under a later pseudonym of the subject.

    `line` is the last one that tells of an attempt under this pseudonym.
    """
    later: list[str] = []
    digest = bytes.fromhex(pseudonym)
    for value in pseudonyms.since(line):
        digest = digest_again(value, digest)
        later.append(digest.hex())
    if not later:
        return False
    log_goes_on = sa.exists(AuditRow.sequence).where(AuditRow.pseudonym.in_(later), ATTEMPT_LINES)
    is_counted = sa.exists(FailedAttemptsRow.line).where(
        FailedAttemptsRow.pseudonym == later[-1], FailedAttemptsRow.line >= line
    )
    return bool(connection.execute(sa.select(sa.or_(log_goes_on, is_counted))).scalar_one())


def _rows(
    connection: Connection, table: type[Base], last_line: sa.ScalarSelect[Any] | None
) -> Iterator[dict[str, Any]]:
    primary_key = sa.inspect(table).primary_key
    query: Any = sa.select(*columns_of(table)).order_by(*primary_key).limit(BATCH)
    if last_line is not None:
        query = query.add_columns(last_line.label("last_line"))
    if table is ApiKeyRow:
        query = query.add_columns(TENANT_OF_KEY.label("tenant"))
    rows = read_rows(connection, query, table)
    while rows:
        yield from (row._asdict() for row in rows)
        place = [rows[-1]._mapping[str(column.key)] for column in primary_key]
        later = sa.tuple_(*primary_key) > sa.tuple_(*map(sa.literal, place))
        rows = read_rows(connection, query.where(later), table)


def read_rows(connection: Connection, query: Any, table: type[Base]) -> Sequence[Any]:
    """Read rows of a table, or raise :class:`StoreError` where one holds what is never written."""
    try:
        return connection.execute(query).all()
    except (ValueError, TypeError):
        # SQLite keeps any value in any column.
        raise StoreError(
            f"a row of the table {table.__tablename__} holds what this program never writes: "
            "it was altered; restore the database from a backup"
        ) from None


_first = (
    sa.select(AuditRow.actor, sa.func.min(AuditRow.sequence).label("line"))
    .where(AuditRow.actor.like("key:%"))
    .group_by(AuditRow.actor)
    .subquery()
)
_ACTORS_WITHOUT_KEY: Any = (
    sa.select(_first.c.actor)
    .where(
        ~sa.exists(AuditRow.sequence).where(
            AuditRow.detail == sa.func.substr(_first.c.actor, 5),
            KEY_LINES,
            AuditRow.action == "key-create",
            AuditRow.sequence < _first.c.line,
        )
    )
    .order_by(_first.c.actor)
)

_last = (
    sa.select(AuditRow.pseudonym, sa.func.max(AuditRow.sequence).label("line"))
    .where(ATTEMPT_LINES, AuditRow.pseudonym.is_not(None))
    .group_by(AuditRow.pseudonym)
    .subquery()
)
_erasure = sa.orm.aliased(AuditRow)
_VANISHED: Any = (
    sa.select(_last.c.pseudonym, _last.c.line)
    .join(AuditRow, AuditRow.sequence == _last.c.line)
    .outerjoin(FailedAttemptsRow, FailedAttemptsRow.pseudonym == _last.c.pseudonym)
    .where(
        AuditRow.outcome == "reject",
        AuditRow.at > sa.bindparam("since", type_=AuditRow.at.type),
        sa.or_(FailedAttemptsRow.line.is_(None), FailedAttemptsRow.line < _last.c.line),
        # An erased tenant's counts went with it.
        ~sa.exists(_erasure.sequence).where(
            _erasure.tenant == AuditRow.tenant,
            TENANT_LINES,
            _erasure.outcome == "erased",
            _erasure.sequence > _last.c.line,
        ),
    )
    .order_by(_last.c.pseudonym)
)

_NONCES_TWICE: Any = (
    sa.select(sa.func.max(AuditRow.sequence))
    .where(NONCE_LINES)
    .group_by(AuditRow.nonce)
    .having(sa.func.count() > 1)
    .order_by(sa.func.max(AuditRow.sequence))
)
