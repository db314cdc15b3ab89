"""Erasing a subject or a tenant: everything about it goes, a signed receipt comes."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.audit_log import PROGRAM, TENANT_ERASE, By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import UnknownTenant, checked_subject_id, checked_tenant_name
from templates.store.receipts import (
    SUBJECT_KIND,
    TENANT_KIND,
    Receipt,
    keep_receipt,
    latest_receipt,
    tenant_receipt_name,
)
from templates.store.schema import (
    ApiKeyRow,
    FailedAttemptsRow,
    RotationKeyRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
)
from templates.store.subject_rows import subject_pk_of
from templates.store.tenants import tenant_of


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
        return self._run(lambda connection: self._erase(connection, tenant, subject_id, by))

    def erase_if(
        self, tenant: str, subject_id: str, condition: sa.ColumnElement[bool], *, by: By
    ) -> Receipt | None:
        """:meth:`erase` a subject whose row meets a condition when it is erased; None otherwise.

        Emptying SQLite's write-ahead log is left to the caller, who may erase many.
        """
        subject_id = checked_subject_id(subject_id)
        query = (
            sa.select(SubjectRow.id)
            .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
            .where(TenantRow.name == tenant, SubjectRow.subject_id == subject_id, condition)
        )

        def work(connection: Connection) -> Receipt | None:
            if connection.execute(query).one_or_none() is None:
                return None
            return self._erase(connection, tenant, subject_id, by)[0]

        return self._context.database.write(work)

    def receipt(self, tenant: str, subject_id: str) -> Receipt | None:
        """Return the latest erasure receipt of a subject, or None."""
        pseudonym = self._context.signer.pseudonym(tenant, checked_subject_id(subject_id))
        return self._context.database.read(lambda connection: latest_receipt(connection, pseudonym))

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
        return self._run(lambda connection: self._erase_tenant(connection, tenant, by))

    def _run(self, work: Callable[[Connection], tuple[Receipt, bool]]) -> Erasure:
        receipt, erased = self._context.database.write(work)
        return Erasure(receipt, erased, log_purged=self._context.database.purge_log())

    def _erase(
        self, connection: Connection, tenant: str, subject_id: str, by: By
    ) -> tuple[Receipt, bool]:
        pseudonym = self._context.signer.pseudonym(tenant, subject_id)
        tenant_id = tenant_of(connection, tenant).id
        subject_pk = subject_pk_of(connection, tenant_id, subject_id)
        failed_attempts = _delete(
            connection,
            FailedAttemptsRow,
            FailedAttemptsRow.tenant_id == tenant_id,
            FailedAttemptsRow.pseudonym == pseudonym,
        )
        receipt = None if subject_pk else latest_receipt(connection, pseudonym)
        outcome = "receipt_repeated"
        if receipt is None:
            contract_id = connection.execute(
                sa.select(TemplateRow.contract_id).where(TemplateRow.subject_pk == subject_pk)
            ).scalar_one_or_none()
            # Its template goes with the subject, by the foreign key.
            subjects = _delete(connection, SubjectRow, SubjectRow.id == subject_pk)
            outcome, now = "erased" if subjects else "nothing_held", self._context.clock()
            receipt = self._context.signer.sign(
                SUBJECT_KIND,
                tenant=tenant,
                subject=pseudonym,
                held=contract_id is not None,
                contract_id=contract_id,
                # The data key is a column of the subject's row, with the metadata.
                erased={
                    **dict.fromkeys(("template", "data_key", "metadata"), subjects),
                    "failed_attempts": failed_attempts,
                },
                erased_at=now,
            )
            keep_receipt(connection, pseudonym, receipt, now)
        self._context.audit_log.append(connection, Entry("erase", outcome, by, tenant, pseudonym))
        return receipt, outcome == "erased"

    def _erase_tenant(self, connection: Connection, tenant: str, by: By) -> tuple[Receipt, bool]:
        name, now = tenant_receipt_name(tenant), self._context.clock()
        try:
            owner = tenant_of(connection, tenant)
        except UnknownTenant:
            earlier = latest_receipt(connection, name)
            if earlier is None:
                raise
            entry = Entry(TENANT_ERASE, "receipt_repeated", by, tenant)
            self._context.audit_log.append(connection, entry)
            return earlier, False
        erased = _counts(connection, owner.id)
        # Everything else of the tenant goes with its row, by the foreign keys.
        _delete(connection, TenantRow, TenantRow.id == owner.id)
        receipt = self._context.signer.sign(
            TENANT_KIND,
            tenant=tenant,
            held=True,
            rotation_epoch=owner.rotation_epoch,
            erased=erased,
            erased_at=now,
        )
        keep_receipt(connection, name, receipt, now)
        self._context.audit_log.append(
            connection, Entry(TENANT_ERASE, "erased", by, tenant, detail=owner.id)
        )
        return receipt, True


def _delete(connection: Connection, table: type[Any], *conditions: Any) -> int:
    return connection.execute(sa.delete(table).where(*conditions)).rowcount


def _counts(connection: Connection, tenant_id: str) -> dict[str, int]:
    """Count the records of a tenant, each kind in the table that holds it."""

    def count(table: type[Any]) -> int:
        query = sa.select(sa.func.count()).select_from(table).where(table.tenant_id == tenant_id)
        return int(connection.execute(query).scalar_one())

    return {
        **dict.fromkeys(("subjects", "templates", "data_keys"), count(SubjectRow)),
        "rotation_keys": count(RotationKeyRow),
        "api_keys": count(ApiKeyRow),
        "failed_attempts": count(FailedAttemptsRow),
    }
