"""Retention: for how long subjects are kept."""

from dataclasses import dataclass
from datetime import datetime, timedelta

import sqlalchemy as sa

from templates.store.schema import SubjectRow


@dataclass(frozen=True)
class Retention:
    """For how long a subject is kept; None is for ever.

    `max_age` is time since the latest enrollment, `max_disuse` since the subject was last accepted,
    or enrolled where that is later.
    """

    max_age: timedelta | None = None
    max_disuse: timedelta | None = None

    def is_due(self, now: datetime) -> sa.ColumnElement[bool]:
        """Condition on a row of ``subjects``: it is due at this time."""
        reasons: list[sa.ColumnElement[bool]] = [sa.false()]
        if self.max_age is not None:
            reasons.append(SubjectRow.updated_at < now - self.max_age)
        if self.max_disuse is not None:
            since = now - self.max_disuse
            last_used = sa.func.coalesce(SubjectRow.last_used_at, SubjectRow.updated_at)
            reasons.append(sa.and_(SubjectRow.updated_at < since, last_used < since))
        return sa.or_(*reasons)
