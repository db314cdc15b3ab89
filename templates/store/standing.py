"""How often verifying a subject failed, by what is counted and by the audit log.

The row of a subject's failures is read with the last line of the audit log that tells of an attempt
on it. It is good if its MAC is true and it is not older than that line. Else the lines themselves
are counted, back to the last accept, reset or erasure: so a row that was removed, altered or put
back from a copy neither lifts a lock nor makes one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy.engine import Connection

from templates.store.attempt_queries import LINES_OF_ATTEMPTS, TENANT_ERASED
from templates.store.audit_chain import Line, is_true_line
from templates.store.authenticity import AUTHENTICATED, is_authentic, row_mac, warn
from templates.store.lockout import LockoutPolicy
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


@dataclass(frozen=True)
class Subject:
    """Whose failures: the names that the rows and lines carry."""

    tenant: str
    pseudonym: str


def standing(
    connection: Connection,
    row: Any,
    subject: Subject,
    *,
    line_key: bytes,
    row_key: bytes,
    policy: LockoutPolicy,
    now: datetime,
) -> AttemptsStatus | None:
    """Return what counts of a subject; None where nothing ever failed.

    Parameters
    ----------
    connection
        Asked for further lines where the row is not good.
    row
        Of ``BEFORE`` or ``STANDING``: with ``COUNTS``, ``LAST_LINE`` and ``subject_pk``.
    subject
        Whose row it is.
    line_key, row_key
        Keys of the audit log's chain and of the MACs of rows.
    policy
        By which a lock follows from lines.
    now
        Time of now.
    """
    values = row._mapping
    counted = _row_of(values)
    row_is_true = counted is not None and is_authentic(row_key, FailedAttemptsRow, counted)
    last = values["last_sequence"] or 0
    if counted is not None and row_is_true and counted["line"] >= last:
        return _status(counted)
    total = counted["total"] if counted is not None and row_is_true else 0
    if values["last_outcome"] != "reject":
        return None if not total or counted is None else _status(counted).cleared()
    found = _counted_in_log(connection, subject, line_key, policy)
    if found is None or (
        # An old count of somebody unknown was removed in its time: see Attempts.expire.
        row.subject_pk is None
        and found.disabled_at is None
        and found.last_failed_at <= now - UNKNOWN_RETENTION
    ):
        return None
    warn(
        "the count of failed attempts on a subject was removed or altered in the database; "
        "it was taken from the audit log",
        tenant=subject.tenant,
        subject=subject.pseudonym[:16],
    )
    return found


def counts_row(
    row_key: bytes, tenant_id: str, pseudonym: str, status: AttemptsStatus, line: int
) -> dict[str, Any]:
    """Columns of a row of ``failed_attempts``, its MAC among them."""
    row = {"tenant_id": tenant_id, "pseudonym": pseudonym, **vars(status), "line": line}
    return {**row, "mac": row_mac(row_key, FailedAttemptsRow, row)}


def _counted_in_log(
    connection: Connection, subject: Subject, line_key: bytes, policy: LockoutPolicy
) -> AttemptsStatus | None:
    most = max(policy.disable_at, 1) if policy.after else _MOST_COUNTED
    lines = connection.execute(
        LINES_OF_ATTEMPTS, {"pseudonym": subject.pseudonym, "most": min(most, _MOST_COUNTED)}
    )
    # An erased tenant's subjects went without lines of their own.
    erased = connection.execute(TENANT_ERASED, {"tenant": subject.tenant}).scalar() or 0
    failed_at: datetime | None = None
    consecutive = 0
    for columns in lines:
        line = Line(*columns)
        if line.sequence < erased:
            break
        if (line.actor or "").startswith("operator") and line.action == "verify":
            continue  # an earlier version's name for what an operator tried, which nothing counts
        # A line that is not true may have been any: it counts as a failure.
        if is_true_line(line_key, line) and line.outcome != "reject":
            break
        failed_at = failed_at or line.at
        consecutive += 1
    if failed_at is None:
        return None
    lock = policy.lock(consecutive)
    return AttemptsStatus(
        consecutive=consecutive,
        total=consecutive,
        last_failed_at=failed_at,
        locked_until=None if lock is None else failed_at + lock,
        disabled_at=failed_at if policy.disables(consecutive) else None,
    )


def _row_of(values: Mapping[str, Any]) -> dict[str, Any] | None:
    """Columns of the subject's row of ``failed_attempts``, or None where there is none."""
    if values["counted_pseudonym"] is None:
        return None
    names = (*AUTHENTICATED[FailedAttemptsRow], "mac")
    return {name: values[f"counted_{name}"] for name in names}


def _status(row: Mapping[str, Any]) -> AttemptsStatus:
    return AttemptsStatus(**{name: row[name] for name in AttemptsStatus.__dataclass_fields__})
