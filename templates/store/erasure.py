"""Erasing a subject: everything about it goes, a signed receipt comes."""

from collections.abc import Callable
from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import checked_subject_id
from templates.store.receipts import Erased, Receipt, keep_receipt, latest_receipt
from templates.store.schema import (
    FailedAttemptsRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
)
from templates.store.subject_rows import subject_lock, subject_pk_of, tenant_id_of


@dataclass(frozen=True)
class Erasure:
    """What :meth:`Erasures.erase` did.

    Attributes
    ----------
    receipt
        The signed receipt.
    erased
        Whether this call removed an enrollment; False when there was none (any more).
    log_purged
        False if SQLite could not empty its write-ahead log just now, as beside a long reader; the
        next erasure or ``purge_log`` does it.
    """

    receipt: Receipt
    erased: bool
    log_purged: bool


class Erasures:
    """Repository of erasure receipts, and the only way to get one."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def erase(self, tenant: str, subject_id: str, *, by: By = PROGRAM) -> Erasure:
        """Remove all that is held of a subject, its data key included; leave a signed receipt.

        In one transaction: template, metadata, data key and failed attempts go, the receipt
        comes. Erasing again returns the receipt of the first time; erasing who
        was never enrolled leaves a receipt that says nothing was held. The receipt counts what its
        own call removed.

        What stays is the receipt, and the lines of the audit log, which name the subject by its
        pseudonym. The nonces of challenges and tokens stay for their few minutes:
        they belong to an API key and name no subject. As the failed attempts go, an erasure ends a
        lock: whoever may erase and enroll a subject may also start its count anew.
        """
        work = self._work(tenant, subject_id, by)
        receipt, erased = self._context.write(work, lock=subject_lock(tenant, subject_id))
        log_purged = self._context.database.purge_log()
        return Erasure(receipt=receipt, erased=erased, log_purged=log_purged)

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

        return self._context.write(work_if, lock=subject_lock(tenant, subject_id))

    def _work(
        self, tenant: str, subject_id: str, by: By
    ) -> Callable[[Connection], tuple[Receipt, bool]]:
        """The transaction of an erasure: what was signed, and whether anybody was enrolled."""
        signer, audit_log = self._context.signer, self._context.audit_log
        checked_subject_id(subject_id)

        def work(connection: Connection) -> tuple[Receipt, bool]:
            pseudonym = signer.pseudonym(tenant, subject_id)
            receipt, outcome = remove(connection, pseudonym)
            audit_log.append(connection, Entry("erase", outcome, by, tenant, pseudonym))
            return receipt, outcome == "erased"

        def remove(connection: Connection, pseudonym: str) -> tuple[Receipt, str]:
            tenant_id = tenant_id_of(connection, tenant)

            failed_attempts = connection.execute(
                sa.delete(FailedAttemptsRow).where(
                    FailedAttemptsRow.tenant_id == tenant_id,
                    FailedAttemptsRow.pseudonym == pseudonym,
                )
            ).rowcount
            contract_id, templates, subjects = None, 0, 0
            subject_pk = subject_pk_of(connection, tenant_id, subject_id)
            if subject_pk is None:
                earlier = latest_receipt(connection, pseudonym)
                if earlier is not None:
                    return earlier, "receipt_repeated"
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
            now = self._context.clock()
            receipt = signer.sign(
                tenant=tenant,
                pseudonym=pseudonym,
                erased=Erased(
                    contract_id=contract_id,
                    template=templates,
                    data_key=subjects,  # a column of the subject's row, with the metadata
                    metadata=subjects,
                    failed_attempts=failed_attempts,
                ),
                erased_at=now,
            )
            keep_receipt(connection, pseudonym, receipt, now)
            return receipt, "nothing_held" if subject_pk is None else "erased"

        return work

    def receipt(self, tenant: str, subject_id: str) -> Receipt | None:
        """Return the latest erasure receipt of a subject, or None."""
        signer = self._context.signer
        checked_subject_id(subject_id)
        return self._context.read(
            lambda connection: latest_receipt(connection, signer.pseudonym(tenant, subject_id))
        )
