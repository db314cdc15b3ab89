"""Erasing a subject: everything about it goes, a signed receipt comes."""

from collections.abc import Callable
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.audit_log import PROGRAM, AuditLog, By, Entry
from templates.store.database import Database
from templates.store.identifiers import Clock, checked_subject_id
from templates.store.receipts import Erased, Receipt, ReceiptSigner
from templates.store.schema import (
    FailedAttemptsRow,
    IdempotencyRow,
    ReceiptRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
)
from templates.store.subjects import subject_lock, subject_row_id, tenant_row


@dataclass(frozen=True)
class Erasure:
    """What :meth:`Erasures.erase` did.

    Attributes
    ----------
    receipt
        The signed receipt.
    erased
        Whether this call removed a template; False when there was none (any more).
    log_purged
        False if SQLite could not empty its write-ahead log just now, as beside a long reader; the
        next erasure or ``purge_log`` does it.
    """

    receipt: Receipt
    erased: bool
    log_purged: bool


class Erasures:
    """Repository of erasure receipts, and the only way to get one."""

    def __init__(
        self, database: Database, signer: ReceiptSigner, audit_log: AuditLog, clock: Clock
    ) -> None:
        self._database = database
        self._signer = signer
        self._audit_log = audit_log
        self._clock = clock

    def erase(self, tenant: str, subject_id: str, *, by: By = PROGRAM) -> Erasure:
        """Remove all that is held of a subject, its data key included; leave a signed receipt.

        In one transaction: template, metadata, data key, failed attempts and idempotency records
        go, the receipt comes. Erasing again returns the receipt of the first time; erasing who
        was never enrolled leaves a receipt that says nothing was held. The receipt counts what its
        own call removed.

        What stays is the receipt, and the lines of the audit log, which name the subject by its
        pseudonym. The nonces of signed probes stay for their few minutes: they belong to an API key
        and name no subject. As the failed attempts go, an erasure ends a lock: whoever may erase
        and enroll a subject may also start its count anew.
        """
        work = self._work(tenant, subject_id, by)
        receipt, erased = self._database.write(work, lock=subject_lock(tenant, subject_id))
        return Erasure(receipt=receipt, erased=erased, log_purged=self._database.try_purge_log())

    def erase_if(
        self, tenant: str, subject_id: str, condition: sa.ColumnElement[bool], *, by: By
    ) -> Receipt | None:
        """:meth:`erase` a subject whose row meets a condition when it is erased.

        Returns
        -------
        Receipt or None
            None where the subject does not meet it, or is not there; nothing is done then.
            Emptying SQLite's write-ahead log is left to the caller, who may erase many.
        """
        work = self._work(tenant, subject_id, by)
        query = (
            sa.select(SubjectRow.id)
            .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
            .where(TenantRow.name == tenant, SubjectRow.subject_id == subject_id, condition)
        )

        def work_if(connection: Connection) -> Receipt | None:
            if connection.execute(query).one_or_none() is None:
                return None
            receipt, _ = work(connection)
            return receipt

        return self._database.write(work_if, lock=subject_lock(tenant, subject_id))

    def _work(
        self, tenant: str, subject_id: str, by: By
    ) -> Callable[[Connection], tuple[Receipt, bool]]:
        """The transaction of an erasure: what was signed, and whether there was a template."""
        checked_subject_id(subject_id)
        pseudonym = self._signer.pseudonym(tenant, subject_id)
        self._signer.public_key()  # obtains the signing key before the transaction needs it
        self._audit_log.prepare()

        def work(connection: Connection) -> tuple[Receipt, bool]:
            receipt, outcome = remove(connection)
            self._audit_log.append(connection, Entry("erase", outcome, by, tenant, pseudonym))
            return receipt, outcome == "erased"

        def remove(connection: Connection) -> tuple[Receipt, str]:
            tenant_id, _ = tenant_row(connection, tenant)
            named_by_pseudonym = {
                table: connection.execute(
                    sa.delete(table).where(
                        table.tenant_id == tenant_id, table.pseudonym == pseudonym
                    )
                ).rowcount
                for table in (FailedAttemptsRow, IdempotencyRow)
            }
            contract_id, templates, subjects = None, 0, 0
            subject_pk = subject_row_id(connection, tenant_id, subject_id)
            if subject_pk is None:
                earlier = connection.execute(
                    sa.select(ReceiptRow.body, ReceiptRow.signature)
                    .where(ReceiptRow.pseudonym == pseudonym)
                    .order_by(ReceiptRow.sequence.desc())
                    .limit(1)
                ).one_or_none()
                if earlier is not None:
                    return Receipt(earlier.body, earlier.signature), "receipt_repeated"
            else:
                contract_id = connection.execute(
                    sa.select(TemplateRow.contract_id).where(TemplateRow.subject_pk == subject_pk)
                ).scalar_one()
                templates = connection.execute(
                    sa.delete(TemplateRow).where(TemplateRow.subject_pk == subject_pk)
                ).rowcount
                subjects = connection.execute(
                    sa.delete(SubjectRow).where(SubjectRow.id == subject_pk)
                ).rowcount
            now = self._clock()
            receipt = self._signer.sign(
                tenant=tenant,
                pseudonym=pseudonym,
                erased=Erased(
                    contract_id=contract_id,
                    template=templates,
                    data_key=subjects,  # a column of the subject's row, with the metadata
                    metadata=subjects,
                    failed_attempts=named_by_pseudonym[FailedAttemptsRow],
                    idempotency_records=named_by_pseudonym[IdempotencyRow],
                ),
                erased_at=now,
            )
            connection.execute(
                sa.insert(ReceiptRow).values(
                    pseudonym=pseudonym,
                    body=receipt.body,
                    signature=receipt.signature,
                    created_at=now,
                )
            )
            return receipt, "nothing_held" if subject_pk is None else "erased"

        return work

    def receipt(self, tenant: str, subject_id: str) -> Receipt | None:
        """Return the latest erasure receipt of a subject, or None."""
        pseudonym = self._signer.pseudonym(tenant, checked_subject_id(subject_id))
        row = self._database.read(
            lambda each: each.execute(
                sa.select(ReceiptRow.body, ReceiptRow.signature)
                .where(ReceiptRow.pseudonym == pseudonym)
                .order_by(ReceiptRow.sequence.desc())
                .limit(1)
            ).one_or_none()
        )
        return None if row is None else Receipt(row.body, row.signature)
