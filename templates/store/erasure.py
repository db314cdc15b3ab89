"""Erasing a subject: everything about it goes, a signed receipt comes."""

from dataclasses import dataclass

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.database import Database
from templates.store.identifiers import Clock, checked_subject_id
from templates.store.receipts import Erased, Receipt, ReceiptSigner
from templates.store.schema import (
    FailedAttemptsRow,
    IdempotencyRow,
    ReceiptRow,
    SubjectRow,
    TemplateRow,
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

    def __init__(self, database: Database, signer: ReceiptSigner, clock: Clock) -> None:
        self._database = database
        self._signer = signer
        self._clock = clock

    def erase(self, tenant: str, subject_id: str) -> Erasure:
        """Remove all that is held of a subject, its data key included; leave a signed receipt.

        In one transaction: template, metadata, data key, failed attempts and idempotency records
        go, the receipt comes. Erasing again returns the receipt of the first time; erasing who
        was never enrolled leaves a receipt that says nothing was held. The receipt counts what its
        own call removed.
        """
        checked_subject_id(subject_id)
        pseudonym = self._signer.pseudonym(tenant, subject_id)
        self._signer.public_key()  # obtains the signing key before the transaction needs it

        def work(connection: Connection) -> tuple[Receipt, bool]:
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
                    return Receipt(earlier.body, earlier.signature), False
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
            return receipt, subject_pk is not None

        receipt, erased = self._database.write(work, lock=subject_lock(tenant, subject_id))
        return Erasure(receipt=receipt, erased=erased, log_purged=self._database.try_purge_log())

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
