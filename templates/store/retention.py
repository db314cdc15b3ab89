"""Retention: subjects whose enrollment is too old, or that were not used for too long, are erased.

Each is erased like any other subject, with a receipt and a line in the audit log, in a transaction
of its own. That transaction asks once more whether the subject is still due, so one that was
enrolled again or accepted since the list was read survives.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.audit_log import By
from templates.store.database import Database
from templates.store.erasure import Erasures
from templates.store.identifiers import Clock, UnknownTenant
from templates.store.schema import SubjectRow, TenantRow, UtcDateTime

BATCH = 100
LONGEST = timedelta(days=36_500)
PURGE_WAIT_S = 0.25
RETENTION = By("retention")


@dataclass(frozen=True)
class Retention:
    """For how long a subject is kept; None is for ever.

    Parameters
    ----------
    max_age
        Time since the latest enrollment.
    max_disuse
        Time since the subject was last accepted, or enrolled where that is later.

    Raises
    ------
    StoreError
        For a time that is not more than nothing, or is more than a hundred years.
    """

    max_age: timedelta | None = None
    max_disuse: timedelta | None = None

    def __post_init__(self) -> None:
        for name, value in (("age", self.max_age), ("disuse", self.max_disuse)):
            if value is not None and not timedelta(0) < value <= LONGEST:
                raise StoreError(
                    f"the longest {name} of an enrollment is more than nothing and at most "
                    f"{LONGEST.days} days; leave it unset to keep enrollments for ever"
                )

    def expired(self, now: datetime) -> sa.ColumnElement[bool]:
        """Condition on a row of ``subjects``: it is due at this time."""
        reasons: list[sa.ColumnElement[bool]] = []
        if self.max_age is not None:
            reasons.append(SubjectRow.updated_at < now - self.max_age)
        if self.max_disuse is not None:
            since = now - self.max_disuse
            unused = sa.or_(SubjectRow.last_used_at.is_(None), SubjectRow.last_used_at < since)
            reasons.append(sa.and_(SubjectRow.updated_at < since, unused))
        return sa.and_(SubjectRow.updated_at < self._enrolled_before(now), sa.or_(*reasons))

    @property
    def keeps_all(self) -> bool:
        """Whether nobody is ever due."""
        return self.max_age is None and self.max_disuse is None

    def _enrolled_before(self, now: datetime) -> datetime:
        # Follows from the reasons; said apart so that the index on the time is used.
        limits = [each for each in (self.max_age, self.max_disuse) if each is not None]
        return now - min(limits)


class _Due(NamedTuple):
    """A subject that was due when the list was read."""

    updated_at: datetime
    row_id: str
    tenant: str
    subject_id: str


def erase_expired(
    database: Database,
    erasures: Erasures,
    clock: Clock,
    retention: Retention,
    *,
    by: By = RETENTION,
    batch: int = BATCH,
) -> int:
    """Erase every subject that is due, of all tenants; returns how many.

    It may be interrupted, run again, and run by several workers at once.

    Parameters
    ----------
    database, erasures, clock
        What to erase from, how, and what time it is.
    retention
        Who is due.
    by
        Actor of the audit lines.
    batch
        Subjects that are listed at once.
    """
    if retention.keeps_all:
        return 0
    expired, erased = retention.expired(clock()), 0
    after: _Due | None = None
    while rows := database.read(partial(_list, expired=expired, after=after, batch=batch)):
        for due in rows:
            erased += _erase(erasures, due, expired, by)
        database.try_purge_log(wait=PURGE_WAIT_S)
        after = rows[-1]
    return erased


def due(database: Database, clock: Clock, retention: Retention) -> int:
    """Count the subjects that :func:`erase_expired` would erase now."""
    if retention.keeps_all:
        return 0
    query = sa.select(sa.func.count()).select_from(SubjectRow).where(retention.expired(clock()))
    return database.read(lambda each: int(each.execute(query).scalar_one()))


def _erase(erasures: Erasures, due: _Due, expired: sa.ColumnElement[bool], by: By) -> bool:
    # The row, too: a tenant or a subject of the same name may have been made anew.
    still = sa.and_(SubjectRow.id == due.row_id, expired)
    try:
        return erasures.erase_if(due.tenant, due.subject_id, still, by=by) is not None
    except UnknownTenant:
        return False


def _list(
    connection: Connection, *, expired: sa.ColumnElement[bool], after: _Due | None, batch: int
) -> Sequence[_Due]:
    query = (
        sa.select(SubjectRow.updated_at, SubjectRow.id, TenantRow.name, SubjectRow.subject_id)
        .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
        .where(expired)
        .order_by(SubjectRow.updated_at, SubjectRow.id)
        .limit(batch)
    )
    if after is not None:
        place = sa.literal(after.updated_at, UtcDateTime()), sa.literal(after.row_id)
        query = query.where(sa.tuple_(SubjectRow.updated_at, SubjectRow.id) > sa.tuple_(*place))
    return [_Due(*row) for row in connection.execute(query)]
