"""Retention: subjects whose enrollment is too old, or that were not used for too long, are erased.

Each is erased like any other subject, with a receipt and a line in the audit log, in a transaction
of its own. That transaction asks once more whether the subject is still due, so one that was
enrolled again or accepted since the list was read survives.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa

from templates.errors import StoreError
from templates.store.audit_log import By
from templates.store.context import StoreContext
from templates.store.erasure import Erasures
from templates.store.schema import SubjectRow, TenantRow

BATCH = 100
LONGEST = timedelta(days=36_500)
RETENTION = By("retention")


@dataclass(frozen=True)
class Retention:
    """For how long a subject is kept; None is for ever.

    `max_age` is time since the latest enrollment, `max_disuse` since the subject was last accepted,
    or enrolled where that is later.
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
        reasons: list[sa.ColumnElement[bool]] = [sa.false()]
        if self.max_age is not None:
            reasons.append(SubjectRow.updated_at < now - self.max_age)
        if self.max_disuse is not None:
            since = now - self.max_disuse
            last_used = sa.func.coalesce(SubjectRow.last_used_at, SubjectRow.updated_at)
            reasons.append(sa.and_(SubjectRow.updated_at < since, last_used < since))
        return sa.or_(*reasons)


class RetentionJob:
    """Erases the subjects whose retention has ended."""

    def __init__(self, context: StoreContext, erasures: Erasures) -> None:
        self._context = context
        self._erasures = erasures

    def erase_expired(self, retention: Retention, *, by: By = RETENTION, batch: int = BATCH) -> int:
        """Erase every subject that is due, of all tenants; returns how many.

        It may be interrupted, run again, and run by several workers at once. `batch` subjects are
        listed at once.
        """
        erased, after, due = 0, "", retention.expired(self._context.clock())
        query = (
            sa.select(SubjectRow.id, TenantRow.name.label("tenant"), SubjectRow.subject_id)
            .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
            .where(due)
            .order_by(SubjectRow.id)
            .limit(batch)
        )
        while rows := self._listed(query.where(SubjectRow.id > after)):
            for row in rows:
                # The row, too: a subject of the same name may have been enrolled anew.
                is_due = sa.and_(SubjectRow.id == row.id, due)
                erased += self._erasures.erase_if(row.tenant, row.subject_id, is_due, by=by)
            self._context.database.purge_log()
            after = rows[-1].id
        return erased

    def _listed(self, query: Any) -> Sequence[Any]:
        with self._context.database.read() as session:
            return session.execute(query).all()

    def due(self, retention: Retention) -> int:
        """Count the subjects that :meth:`erase_expired` would erase now."""
        due = retention.expired(self._context.clock())
        with self._context.database.read() as session:
            query = sa.select(sa.func.count()).select_from(SubjectRow).where(due)
            return session.execute(query).scalar_one()
