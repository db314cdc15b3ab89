"""Verifying the audit log, and holding the rows of other tables against it.

An attacker who can write the database, but has no master key, can put back a row as it once was.
It is a true row, so the service takes it. The log, which tells that it ended, is what shows it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.store.attempts import COUNT_RETENTION
from templates.store.audit_chain import (
    START,
    Anchor,
    BrokenAuditLog,
    ChainBreak,
    Head,
    good_lines,
)
from templates.store.audit_log import TENANT_ERASE, template_digest
from templates.store.repository import TemplateStore
from templates.store.schema import FailedAttemptsRow, SubjectRow, TenantRow

KEY_ALTERED = "the row of an API key was made up or altered"
KEY_PUT_BACK = "an API key that was revoked was put back"
ENROLLMENT_PUT_BACK = "an enrollment that was erased or replaced was put back"
TENANT_PUT_BACK = "a tenant that was erased was put back"
TENANT_ALTERED = "a setting of a tenant was changed"
COUNT_LIFTED = "a count of failed attempts was lowered or removed"

# Named, because a refused call leaves a line too, with the same action and its error code.
_ERASES = {("erase", "erased"), ("erase", "nothing_held"), ("erase", "receipt_repeated")}
_ENDS_FAILURES = {("verify", "accept"), ("lockout-reset", "reset")}
# An hour of slack for clocks that differ.
_FORGOTTEN_AFTER = COUNT_RETENTION - timedelta(hours=1)
# Row and line take the time one after the other.
_SAME_WRITE = timedelta(seconds=10)


@dataclass(frozen=True)
class RecordProblem:
    """A row that contradicts the audit log; `about` is ``key:<prefix>`` or a pseudonym."""

    what: str
    about: str


@dataclass(frozen=True)
class Verification:
    """What a walk over the whole chain showed: good lines, the last of them, the first break.

    If the chain is whole, `records` are the rows that contradict the log.
    """

    lines: int
    head: Anchor
    problem: ChainBreak | None
    records: tuple[RecordProblem, ...] = ()

    @property
    def intact(self) -> bool:
        """Whether nothing is wrong."""
        return self.problem is None and not self.records


@dataclass
class _Failures:
    tenant: str
    last_at: datetime
    consecutive: int = 0


@dataclass
class LogFindings:
    """What the lines of the log tell, up to the last one that was read."""

    ended_keys: set[str] = field(default_factory=set)
    erased_tenants: set[str] = field(default_factory=set)
    settings: dict[str, bool] = field(default_factory=dict)
    failures: dict[str, _Failures] = field(default_factory=dict)
    templates: dict[str, str | None] = field(default_factory=dict)

    def read(self, line: Mapping[str, Any]) -> None:
        """Take note of a line."""
        action, outcome, tenant = line["action"], line["outcome"], line["tenant"]
        pseudonym, detail = line["pseudonym"], line["detail"]
        if action == "key-revoke" and outcome == "revoked":
            self.ended_keys.add(detail)
        elif action == "tenant-settings":
            self.settings[tenant] = outcome == "template-enrollment-on"
        elif action == TENANT_ERASE and outcome == "erased":
            self.erased_tenants.add(detail)
            self.settings.pop(tenant, None)
            for each in [p for p, f in self.failures.items() if f.tenant == tenant]:
                del self.failures[each]
        elif action in ("enroll", "import") and outcome in ("created", "replaced"):
            self.templates[pseudonym] = detail
        elif (action, outcome) in _ERASES:
            self.failures.pop(pseudonym, None)
            self.templates[pseudonym] = None
        elif action == "verify" and outcome == "reject":
            self._count(pseudonym, tenant, datetime.fromisoformat(line["at"]))
        elif (action, outcome) in _ENDS_FAILURES and pseudonym in self.failures:
            self.failures[pseudonym].consecutive = 0

    def _count(self, pseudonym: str, tenant: str, at: datetime) -> None:
        failures = self.failures.setdefault(pseudonym, _Failures(tenant, at))
        if failures.last_at <= at - _FORGOTTEN_AFTER:
            failures.consecutive = 0
        failures.consecutive += 1
        failures.last_at = at


def verify_audit_log(
    store: TemplateStore,
    *,
    anchor: Anchor | None = None,
    progress: Callable[[int], None] | None = None,
) -> Verification:
    """Walk over the audit log, and hold rows of the same moment against what it tells.

    It runs beside a service in use. `progress` is called with the number of further lines. Without
    an `anchor`, an earlier head, an old state of the whole log is not told from a new one. What
    lines in an archive tell is not known.
    """
    findings, key, lines, last = LogFindings(), store.audit_log.key, 0, START
    with store.database.snapshot() as session:
        try:
            head = Head.read(session, key)
            last, is_anchored = head.base, anchor in (None, head.base)
            for line in good_lines(session, key, head, progress=progress):
                findings.read(line)
                last, lines = Anchor(line["sequence"], line["mac"]), lines + 1
                is_anchored |= last == anchor
            if anchor is not None and not is_anchored:
                raise ChainBreak(anchor.sequence, "anchor not in chain")
        except BrokenAuditLog:
            return Verification(lines, last, ChainBreak(0, "head does not match"))
        except ChainBreak as problem:
            return Verification(lines, last, problem)
        records = (
            *_keys(findings, store, session),
            *_tenants(findings, session),
            *_enrollments(findings, store, session),
            *_counts(findings, store, session),
        )
        return Verification(lines, last, None, records)


def _keys(findings: LogFindings, store: TemplateStore, session: Session) -> Iterator[RecordProblem]:
    try:
        keys = store.api_keys.read_all(session)
    except StoreError:
        yield RecordProblem(KEY_ALTERED, "a row that cannot be read")
        return
    for key in keys:
        if not key.authentic:
            yield RecordProblem(KEY_ALTERED, f"key:{key.prefix}")
        elif key.prefix in findings.ended_keys and key.revoked_at is None:
            yield RecordProblem(KEY_PUT_BACK, f"key:{key.prefix}")


def _tenants(findings: LogFindings, session: Session) -> Iterator[RecordProblem]:
    columns = TenantRow.id, TenantRow.name, TenantRow.template_enrollment
    for tenant_id, name, template_enrollment in session.execute(sa.select(*columns)):
        if tenant_id in findings.erased_tenants:
            yield RecordProblem(TENANT_PUT_BACK, name)
        elif findings.settings.get(name, template_enrollment) != template_enrollment:
            yield RecordProblem(TENANT_ALTERED, name)


def _enrollments(
    findings: LogFindings, store: TemplateStore, session: Session
) -> Iterator[RecordProblem]:
    query = sa.select(TenantRow.name, SubjectRow.subject_id, SubjectRow.template_id).join(
        SubjectRow, SubjectRow.tenant_id == TenantRow.id
    )
    for tenant, subject_id, template_id in session.execute(query):
        pseudonym = store.signer.pseudonym(tenant, subject_id)
        digest = template_digest(template_id)
        if findings.templates.get(pseudonym, digest) != digest:
            yield RecordProblem(ENROLLMENT_PUT_BACK, pseudonym)


def _counts(
    findings: LogFindings, store: TemplateStore, session: Session
) -> Iterator[RecordProblem]:
    try:
        stored = {row.pseudonym: row for row in session.scalars(sa.select(FailedAttemptsRow))}
    except StoreError:
        yield RecordProblem(COUNT_LIFTED, "a row that cannot be read")
        return
    for pseudonym, failures in findings.failures.items():
        row = stored.get(pseudonym)
        # The row counts what the log tells, and its last failure is the log's.
        holds = (
            row is not None
            and row.consecutive >= failures.consecutive
            and abs(row.last_failed_at - failures.last_at) < _SAME_WRITE
        )
        if not holds and failures.last_at > store.clock() - _FORGOTTEN_AFTER:
            yield RecordProblem(COUNT_LIFTED, pseudonym)
