"""What a database writer put back: rows that the audit log tells to have ended.

An attacker who can write the database, but has no master key, can put back a row as it once was.
It is a true row, so the service takes it. The log, which tells that it ended, is what shows it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.api_keys import ApiKey, ApiKeys
from templates.store.attempts import COUNT_RETENTION
from templates.store.audit_log import TENANT_ERASE, Anchor, AuditLog, Verification
from templates.store.context import StoreContext
from templates.store.schema import FailedAttemptsRow, SubjectRow, TenantRow

KEY_ALTERED = "the row of an API key was made up or altered"
KEY_PUT_BACK = "an API key that was revoked, replaced or erased was put back"
ENROLLMENT_PUT_BACK = "an enrollment that was erased was put back"
COUNT_LIFTED = "a count of failed attempts was lowered or removed"

# Named, because a refused call leaves a line too, with the same action and its error code.
_REMOVES_COUNT = {("erase", "erased"), ("erase", "nothing_held"), ("erase", "receipt_repeated")}
_ENDS_FAILURES = {("verify", "accept"), ("lockout-reset", "reset")}
# An hour less: a clock that differs by less than that removed nothing wrongly.
_FORGOTTEN_AFTER = COUNT_RETENTION - timedelta(hours=1)


@dataclass(frozen=True)
class RecordProblem:
    """A row that contradicts the audit log; `about` is ``key:<prefix>`` or a pseudonym."""

    what: str
    about: str


@dataclass
class _Failures:
    tenant: str
    last_at: datetime
    consecutive: int = 0
    total: int = 0


@dataclass
class _Told:
    """What the lines of the log tell, up to the last one that was read."""

    ended_keys: set[str] = field(default_factory=set)
    replaced_keys: dict[str, datetime] = field(default_factory=dict)
    keys_of_tenants: dict[str, set[str]] = field(default_factory=dict)
    failures: dict[str, _Failures] = field(default_factory=dict)
    enrolled: dict[str, str] = field(default_factory=dict)
    erased: set[str] = field(default_factory=set)

    def read(self, line: Mapping[str, Any]) -> None:
        """Take note of a line."""
        action, outcome, tenant = line["action"], line["outcome"], line["tenant"]
        if action == "key-create":
            self.keys_of_tenants.setdefault(tenant, set()).add(line["detail"])
        elif action == "key-revoke" and outcome == "revoked":
            self.ended_keys.add(line["detail"])
        elif action == "key-replace":
            prefix, _, ends = line["detail"].partition(" ")
            if ends:
                until = datetime.fromisoformat(ends)
                self.replaced_keys[prefix] = min(until, self.replaced_keys.get(prefix, until))
        elif action == TENANT_ERASE and outcome == "erased":
            self.ended_keys |= self.keys_of_tenants.pop(tenant, set())
            self.erased |= {each for each, owner in self.enrolled.items() if owner == tenant}
            for pseudonym in [p for p, f in self.failures.items() if f.tenant == tenant]:
                del self.failures[pseudonym]
        elif action in ("enroll", "import") and outcome in ("created", "replaced"):
            self.enrolled[line["pseudonym"]] = tenant
            self.erased.discard(line["pseudonym"])
        elif (action, outcome) in _REMOVES_COUNT:
            self.failures.pop(line["pseudonym"], None)
            if self.enrolled.pop(line["pseudonym"], None):
                self.erased.add(line["pseudonym"])
        elif action == "verify" and outcome == "reject":
            self._count(line["pseudonym"], tenant, datetime.fromisoformat(line["at"]))
        elif (action, outcome) in _ENDS_FAILURES and line["pseudonym"] in self.failures:
            self.failures[line["pseudonym"]].consecutive = 0

    def _count(self, pseudonym: str, tenant: str, at: datetime) -> None:
        failures = self.failures.setdefault(pseudonym, _Failures(tenant, at))
        if failures.last_at <= at - _FORGOTTEN_AFTER:
            failures.consecutive = failures.total = 0
        failures.consecutive += 1
        failures.total += 1
        failures.last_at = at


def verify_log_and_records(
    context: StoreContext,
    api_keys: ApiKeys,
    *,
    anchor: Anchor | None = None,
    progress: Callable[[int], None] | None = None,
) -> tuple[Verification, tuple[RecordProblem, ...]]:
    """Walk over the audit log, and hold keys, enrollments and counts against it.

    Parameters
    ----------
    anchor, progress
        As of :meth:`AuditLog.verify`.

    Returns
    -------
    The walk, and the rows that contradict it. Rows are looked at only where the log is whole. What
    lines in an archive tell is not known.
    """
    told = _Told()
    log: AuditLog = context.audit_log
    verification = log.verify(anchor=anchor, seen=told.read, progress=progress)
    if not verification.intact:
        return verification, ()

    def work(connection: Connection) -> tuple[RecordProblem, ...]:
        # No other write runs now, so no line is younger than a row.
        for line in log.lines_after(connection, verification.head):
            told.read(line)
        return (
            *_keys(told, api_keys, connection),
            *_enrollments(told, context, connection),
            *_counts(told, context, connection),
        )

    return verification, context.database.write(work)


def _keys(told: _Told, api_keys: ApiKeys, connection: Connection) -> list[RecordProblem]:
    problems = []
    for key in api_keys.read_all(connection):
        if not key.authentic:
            problems.append(RecordProblem(KEY_ALTERED, f"key:{key.prefix}"))
        elif _is_back(told, key):
            problems.append(RecordProblem(KEY_PUT_BACK, f"key:{key.prefix}"))
    return problems


def _is_back(told: _Told, key: ApiKey) -> bool:
    if key.prefix in told.ended_keys and key.revoked_at is None:
        return True
    ends = told.replaced_keys.get(key.prefix)
    return ends is not None and (key.expires_at is None or key.expires_at > ends)


def _enrollments(told: _Told, context: StoreContext, connection: Connection) -> list[RecordProblem]:
    query = sa.select(TenantRow.name, SubjectRow.subject_id).join(
        TenantRow, TenantRow.id == SubjectRow.tenant_id
    )
    pseudonyms = (context.signer.pseudonym(*row) for row in connection.execute(query))
    return [RecordProblem(ENROLLMENT_PUT_BACK, each) for each in pseudonyms if each in told.erased]


def _counts(told: _Told, context: StoreContext, connection: Connection) -> list[RecordProblem]:
    columns = (
        FailedAttemptsRow.pseudonym,
        FailedAttemptsRow.consecutive,
        FailedAttemptsRow.total,
    )
    rows = connection.execute(sa.select(*columns))
    stored = {row.pseudonym: (row.consecutive, row.total) for row in rows}
    return [
        RecordProblem(COUNT_LIFTED, pseudonym)
        for pseudonym, failures in told.failures.items()
        if failures.last_at > context.clock() - _FORGOTTEN_AFTER
        and _is_lower(stored.get(pseudonym, (0, 0)), failures)
    ]


def _is_lower(stored: tuple[int, int], failures: _Failures) -> bool:
    consecutive, total = stored
    return consecutive < failures.consecutive or total < failures.total
