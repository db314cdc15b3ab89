"""What a database writer put back: rows that the audit log tells to have ended.

An attacker who can write the database, but has no master key, can put back a row as it once was.
It is a true row, so the service takes it. The log, which tells that it ended, is what shows it.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.api_keys import ApiKeys
from templates.store.attempts import COUNT_RETENTION
from templates.store.audit_chain import Anchor
from templates.store.audit_log import TENANT_ERASE, Verification, template_digest
from templates.store.context import StoreContext
from templates.store.schema import FailedAttemptsRow, SubjectRow, TemplateRow, TenantRow

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


@dataclass
class _Failures:
    tenant: str
    last_at: datetime
    consecutive: int = 0
    total: int = 0


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
    """Walk over the audit log, and hold rows of the same moment against what it tells.

    Rows are looked at only where the log is whole. What lines in an archive tell is not known.
    """
    findings, key = LogFindings(), context.audit_log.key

    def work(connection: Connection) -> tuple[Verification, tuple[RecordProblem, ...]]:
        verification = context.audit_log.walk(
            connection, key, anchor=anchor, seen=findings.read, progress=progress
        )
        if not verification.intact:
            return verification, ()
        return verification, (
            *_keys(findings, api_keys, connection),
            *_tenants(findings, connection),
            *_enrollments(findings, context, connection),
            *_counts(findings, context, connection),
        )

    return context.database.snapshot(work)


def _keys(
    findings: LogFindings, api_keys: ApiKeys, connection: Connection
) -> Iterator[RecordProblem]:
    try:
        keys = api_keys.read_all(connection)
    except StoreError:
        yield RecordProblem(KEY_ALTERED, "a row that cannot be read")
        return
    for key in keys:
        if not key.authentic:
            yield RecordProblem(KEY_ALTERED, f"key:{key.prefix}")
        elif key.prefix in findings.ended_keys and key.revoked_at is None:
            yield RecordProblem(KEY_PUT_BACK, f"key:{key.prefix}")


def _tenants(findings: LogFindings, connection: Connection) -> Iterator[RecordProblem]:
    columns = TenantRow.id, TenantRow.name, TenantRow.template_enrollment
    for tenant_id, name, template_enrollment in connection.execute(sa.select(*columns)):
        if tenant_id in findings.erased_tenants:
            yield RecordProblem(TENANT_PUT_BACK, name)
        elif findings.settings.get(name, template_enrollment) != template_enrollment:
            yield RecordProblem(TENANT_ALTERED, name)


def _enrollments(
    findings: LogFindings, context: StoreContext, connection: Connection
) -> Iterator[RecordProblem]:
    query = (
        sa.select(TenantRow.name, SubjectRow.subject_id, TemplateRow.template_id)
        .join(SubjectRow, SubjectRow.tenant_id == TenantRow.id)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
    )
    for tenant, subject_id, template_id in connection.execute(query):
        pseudonym = context.signer.pseudonym(tenant, subject_id)
        digest = template_digest(template_id)
        if findings.templates.get(pseudonym, digest) != digest:
            yield RecordProblem(ENROLLMENT_PUT_BACK, pseudonym)


def _counts(
    findings: LogFindings, context: StoreContext, connection: Connection
) -> Iterator[RecordProblem]:
    rows = connection.execute(sa.select(FailedAttemptsRow.__table__))
    stored = {row.pseudonym: row for row in rows}
    for pseudonym, failures in findings.failures.items():
        row = stored.get(pseudonym)
        # The row counts what the log tells, and its last failure is the log's.
        holds = (
            row is not None
            and row.consecutive >= failures.consecutive
            and row.total >= failures.total
            and abs(row.last_failed_at - failures.last_at) < _SAME_WRITE
        )
        if not holds and failures.last_at > context.clock() - _FORGOTTEN_AFTER:
            yield RecordProblem(COUNT_LIFTED, pseudonym)
