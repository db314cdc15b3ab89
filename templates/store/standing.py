"""How often verifying a subject failed, by what is counted and by the audit log.

The row of a subject's failures is read with the last line of the audit log that tells of an attempt
on it. It is good if its MAC is true and it is not older than that line. Else the lines themselves
are counted, back to the last accept, reset or erasure: so a row that was removed, altered or put
back from a copy neither lifts a lock nor makes one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy.engine import Connection

from templates.store.attempt_queries import (
    FIRST_COUNTS,
    LINES_OF_ATTEMPTS,
    NEXT_COUNTS,
    TENANT_ERASED,
)
from templates.store.audit_chain import Line, is_true_line
from templates.store.authenticity import AUTHENTICATED, is_authentic, row_mac, warn
from templates.store.context import StoreContext
from templates.store.lockout import LockedOut, LockoutPolicy
from templates.store.schema import FailedAttemptsRow

UNKNOWN_RETENTION = timedelta(days=90)

_MOST_COUNTED = 1000


@dataclass(frozen=True)
class AttemptsStatus:
    """Failures on a subject; `consecutive` counts from the last accept or reset on."""

    consecutive: int
    total: int
    last_failed_at: datetime
    locked_until: datetime | None
    disabled_at: datetime | None

    @property
    def holds_something(self) -> bool:
        """Whether there is anything that a reset would lift."""
        return self.consecutive > 0 or self.locked_until is not None or self.disabled_at is not None

    def cleared(self) -> "AttemptsStatus":
        """After an accept or a reset: the total stays."""
        return AttemptsStatus(0, self.total, self.last_failed_at, None, None)


class Standing:
    """Tells how often verifying a subject failed, and writes its row.

    `policy` says when a lock follows from failures.
    """

    def __init__(self, context: StoreContext, policy: LockoutPolicy) -> None:
        self._context = context
        self._policy = policy

    def of(
        self, connection: Connection, row: Any, *, tenant: str, pseudonyms: Sequence[str]
    ) -> AttemptsStatus | None:
        """Return what counts of a subject; None where nothing ever failed.

        Parameters
        ----------
        connection
            Asked for further lines where the row is not good.
        row
            Of ``before`` or ``standing``: with ``COUNTS``, the last line and ``subject_pk``.
        tenant, pseudonyms
            Whose row it is: it has the first of the pseudonyms.
        """
        row_key = self._context.audit_log.row_key()
        counts = _counts_of(row)
        if counts is not None and not is_authentic(row_key, FailedAttemptsRow, counts):
            counts = None
        if counts is not None and counts["line"] >= (row.last_sequence or 0):
            return _status(counts)
        if row.last_outcome != "reject":
            return None if counts is None or not counts["total"] else _status(counts).cleared()
        status = self._counted_in_log(connection, tenant, pseudonyms)
        if status is None or (
            # An old count of somebody unknown was removed in its time: see Attempts.expire.
            row.subject_pk is None
            and status.disabled_at is None
            and status.last_failed_at <= self._context.clock() - UNKNOWN_RETENTION
        ):
            return None
        warn(
            "the count of failed attempts on a subject was removed or altered in the database; "
            "it was taken from the audit log",
            tenant=tenant,
            subject=pseudonyms[0][:16],
        )
        return status

    def after_failure(self, status: AttemptsStatus | None) -> AttemptsStatus:
        """Status of a subject that has just failed once more."""
        consecutive, total = (0, 0) if status is None else (status.consecutive, status.total)
        return self._failed(consecutive + 1, total + 1, self._context.clock())

    def _failed(self, consecutive: int, total: int, at: datetime) -> AttemptsStatus:
        """Status of a subject with so many failures, the last one at a time."""
        lock = self._policy.lock(consecutive)
        return AttemptsStatus(
            consecutive=consecutive,
            total=total,
            last_failed_at=at,
            locked_until=None if lock is None else at + lock,
            disabled_at=at if self._policy.disables(consecutive) else None,
        )

    def refuse_locked(self, status: AttemptsStatus | None) -> None:
        """Raise :class:`LockedOut` where the subject is locked now.

        A lock that began later than now, by more than its own length, does not hold: the clock was
        set back, and the lock would last until the earlier time comes again.
        """
        if not self._policy.after or status is None:
            return
        if status.disabled_at is not None:
            raise LockedOut(None)
        now, until = self._context.clock(), status.locked_until
        if until is None or now >= until:
            return
        if status.last_failed_at - now < until - status.last_failed_at:
            raise LockedOut((until - now).total_seconds())

    def write(
        self, connection: Connection, row: Any, pseudonym: str, status: AttemptsStatus, line: int
    ) -> None:
        """Write the row of a subject's failures; only the holder of the subject's lock does."""
        identity = {"tenant_id": row.tenant_id, "pseudonym": pseudonym}
        counts = {**vars(status), "line": line}
        mac = row_mac(self._context.audit_log.row_key(), FailedAttemptsRow, {**identity, **counts})
        # As the transaction finds it: an erasure since the decision must not leave a count that
        # only another erasure would remove.
        values = {**counts, "known": row.subject_pk is not None, "mac": mac}
        if row.counted_pseudonym is None:
            connection.execute(FIRST_COUNTS, {**identity, **values})
        else:
            of = {"of_tenant": row.tenant_id, "of_pseudonym": pseudonym}
            connection.execute(NEXT_COUNTS, {**of, **values})

    def _counted_in_log(
        self, connection: Connection, tenant: str, pseudonyms: Sequence[str]
    ) -> AttemptsStatus | None:
        policy = self._policy
        most = max(policy.disable_at, 1) if policy.after else _MOST_COUNTED
        rows = connection.execute(
            LINES_OF_ATTEMPTS, {"pseudonyms": pseudonyms, "most": min(most, _MOST_COUNTED)}
        )
        # An erased tenant's subjects went without lines of their own.
        erased = connection.execute(TENANT_ERASED, {"tenant": tenant}).scalar() or 0
        line_keys = self._context.audit_log.line_keys()
        failed_at: datetime | None = None
        consecutive = 0
        for row in rows:
            line = Line(**row._mapping)
            if line.sequence < erased:
                break
            if (line.actor or "").startswith("operator") and line.action == "verify":
                continue  # an earlier version's name for what an operator tried: nothing counts it
            # A line that is not true may have been any: it counts as a failure.
            if is_true_line(line_keys, line) and line.outcome != "reject":
                break
            failed_at = failed_at or line.at
            consecutive += 1
        return None if failed_at is None else self._failed(consecutive, consecutive, failed_at)


def _counts_of(row: Any) -> dict[str, Any] | None:
    """Columns of the subject's row of ``failed_attempts``, or None where there is none."""
    if row.counted_pseudonym is None:
        return None
    names = (*AUTHENTICATED[FailedAttemptsRow], "mac")
    return {name: row._mapping[f"counted_{name}"] for name in names}


def _status(counts: Mapping[str, Any]) -> AttemptsStatus:
    return AttemptsStatus(**{name: counts[name] for name in AttemptsStatus.__dataclass_fields__})
