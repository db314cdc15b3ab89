"""Erasing a subject or a tenant: everything about it goes, a signed receipt comes."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError, StoreUnavailable
from templates.store.audit_chain import BrokenAuditLog
from templates.store.audit_log import PROGRAM, TENANT_ERASE, By, Entry
from templates.store.context import StoreContext
from templates.store.database import delete
from templates.store.identifiers import UnknownTenant, checked_subject_id, checked_tenant_name
from templates.store.receipts import (
    SUBJECT_KIND,
    TENANT_KIND,
    Receipt,
    keep_receipt,
    latest_receipt,
    tenant_receipt_name,
)
from templates.store.retention import Retention
from templates.store.schema import IDS, Base, FailedAttemptsRow, SubjectRow, TenantRow
from templates.store.subjects import subject_of
from templates.store.tenants import tenant_of

BATCH = 100
RETENTION = By("retention")


@dataclass(frozen=True)
class Erasure:
    """What an erasure did: its receipt, and whether this call removed something.

    `log_purged` is False if SQLite could not empty its write-ahead log just now, as beside a long
    reader; the next erasure or ``purge_log`` does it.
    """

    receipt: Receipt
    erased: bool
    log_purged: bool


class Erasures:
    """Erases subjects and tenants, and keeps their receipts."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def erase(self, tenant: str, subject_id: str, *, by: By = PROGRAM) -> Erasure:
        """Remove all that is held of a subject, its data key included; leave a signed receipt.

        In one transaction: template, metadata, data key and failed attempts go, the receipt
        comes. Erasing again returns the receipt of the first time; erasing a subject that was
        never enrolled leaves a receipt that says nothing was held. The receipt counts what its
        own call removed.

        What stays is the receipt, and the lines of the audit log, which name the subject by its
        pseudonym. As the failed attempts go, an erasure ends a lock: a caller who may erase and
        enroll a subject may also start its count anew.
        """
        subject_id = checked_subject_id(subject_id)
        with self._context.database.write() as session:
            receipt, erased = self._erase(session, tenant, subject_id, by)
        return Erasure(receipt, erased, log_purged=self._context.database.purge_log())

    def erase_expired(self, retention: Retention, *, by: By = RETENTION, batch: int = BATCH) -> int:
        """Erase every subject whose retention has ended, of all tenants; returns how many.

        Each like any other subject, with a receipt and a line in the audit log, in a transaction of
        its own. It may be interrupted, run again, and run by several workers at once. `batch`
        subjects are listed at once. :class:`StoreError` at the end, if rows of tenants or subjects
        were altered so that they cannot be erased; all others are erased.
        """
        erased, broken, after = 0, 0, ""
        due = retention.is_due(self._context.clock())
        while rows := self._listed(due & (SubjectRow.id > after), batch):
            for row in rows:
                after = row.id
                # The row, too: a subject of the same name may have been enrolled anew.
                is_due = sa.and_(SubjectRow.id == row.id, due)
                try:
                    erased += self.erase_if(row.name, row.subject_id, is_due, by=by)
                except (StoreUnavailable, BrokenAuditLog):
                    raise
                except (StoreError, TypeError):
                    broken += 1
            self._context.database.purge_log()
        if broken:
            raise StoreError(
                f"{broken} subjects whose retention has ended could not be erased, because rows "
                f"were altered; {erased} were erased. Run `veilface audit-log verify`"
            )
        return erased

    def erase_if(
        self, tenant: str, subject_id: str, condition: sa.ColumnElement[bool], *, by: By
    ) -> bool:
        """:meth:`erase` a subject if its row meets a condition when it is erased.

        So one that was enrolled again or accepted since it was listed survives. Emptying SQLite's
        write-ahead log is left to the caller, who may erase many.
        """
        with self._context.database.write() as session:
            is_met = session.scalar(sa.select(SubjectRow.id).where(condition)) is not None
            return is_met and self._erase(session, tenant, subject_id, by)[1]

    def _listed(self, due: sa.ColumnElement[bool], batch: int) -> Sequence[Any]:
        query = sa.select(SubjectRow.id, TenantRow.name, SubjectRow.subject_id).join(TenantRow)
        with self._context.database.read() as session:
            return session.execute(query.where(due).order_by(SubjectRow.id).limit(batch)).all()

    def count_due(self, retention: Retention) -> int:
        """Count the subjects that :meth:`erase_expired` would erase now."""
        due = retention.is_due(self._context.clock())
        with self._context.database.read() as session:
            return session.execute(sa.select(sa.func.count(SubjectRow.id)).where(due)).scalar_one()

    def receipt(self, tenant: str, subject_id: str) -> Receipt | None:
        """Return the latest erasure receipt of a subject, or None."""
        pseudonym = self._context.signer.pseudonym(tenant, checked_subject_id(subject_id))
        with self._context.database.read() as session:
            return latest_receipt(session, pseudonym)

    def erase_tenant(self, tenant: str, *, by: By = PROGRAM) -> Erasure:
        """Remove all that is held of a tenant, its keys included; leave one signed receipt.

        In one transaction, for which every other write waits. Erasing again returns the receipt of
        the first time. A tenant that is made anew under the same name later is another one.

        Raises
        ------
        UnknownTenant
            If there never was a tenant of this name.
        """
        checked_tenant_name(tenant)
        with self._context.database.write() as session:
            receipt, erased = self._erase_tenant(session, tenant, by)
        return Erasure(receipt, erased, log_purged=self._context.database.purge_log())

    def _erase(
        self, session: Session, tenant: str, subject_id: str, by: By
    ) -> tuple[Receipt, bool]:
        pseudonym = self._context.signer.pseudonym(tenant, subject_id)
        tenant_id = tenant_of(session, tenant).id
        subject = subject_of(session, tenant, subject_id, IDS)
        failed_attempts = delete(
            session,
            FailedAttemptsRow,
            FailedAttemptsRow.tenant_id == tenant_id,
            FailedAttemptsRow.pseudonym == pseudonym,
        )
        receipt = None if subject else latest_receipt(session, pseudonym)
        outcome = "receipt_repeated"
        if receipt is None:
            outcome = "erased" if subject else "nothing_held"
            subjects = delete(session, SubjectRow, SubjectRow.id == subject.id) if subject else 0
            receipt = self._context.signer.sign(
                SUBJECT_KIND,
                tenant=tenant,
                subject=pseudonym,
                held=subject is not None,
                contract_id=subject and str(subject.contract_id),
                # Template, data key and metadata are columns of the subject's row.
                erased={
                    **dict.fromkeys(("template", "data_key", "metadata"), subjects),
                    "failed_attempts": failed_attempts,
                },
                erased_at=self._context.clock(),
            )
            keep_receipt(session, pseudonym, receipt)
        self._context.audit_log.append(session, Entry("erase", outcome, by, tenant, pseudonym))
        return receipt, outcome == "erased"

    def _erase_tenant(self, session: Session, tenant: str, by: By) -> tuple[Receipt, bool]:
        name = tenant_receipt_name(tenant)
        try:
            owner = tenant_of(session, tenant)
        except UnknownTenant:
            earlier = latest_receipt(session, name)
            if earlier is None:
                raise
            entry = Entry(TENANT_ERASE, "receipt_repeated", by, tenant)
            self._context.audit_log.append(session, entry)
            return earlier, False
        erased = _counts(session, owner.id)
        # Everything else of the tenant goes with its row, by the foreign keys.
        delete(session, TenantRow, TenantRow.id == owner.id)
        receipt = self._context.signer.sign(
            TENANT_KIND,
            tenant=tenant,
            held=True,
            rotation_epoch=owner.rotation_epoch,
            erased=erased,
            erased_at=self._context.clock(),
        )
        keep_receipt(session, name, receipt)
        entry = Entry(TENANT_ERASE, "erased", by, tenant, detail=owner.id)
        self._context.audit_log.append(session, entry)
        return receipt, True


def _counts(session: Session, tenant_id: str) -> dict[str, int]:
    """Count the records of a tenant in each table that holds some."""

    def count(table: sa.Table) -> int:
        query = sa.select(sa.func.count()).where(table.c.tenant_id == tenant_id)
        return session.execute(query).scalar_one()

    tables = [table for table in Base.metadata.sorted_tables if "tenant_id" in table.c]
    counts = {table.name: count(table) for table in tables}
    # A subject's row has its template and its data key.
    return counts | dict.fromkeys(("templates", "data_keys"), counts["subjects"])
