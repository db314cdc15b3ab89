"""Erasing a whole tenant: in bounded steps, then its row with whatever is left, for one receipt.

Its API keys are revoked first, so that no request of its own arrives any more. Then records go in
small transactions beside a service in use, and a count of them is kept, so that a run that was
interrupted is finished by the next one and its receipt counts everything. The last transaction
runs while no other write does: what an enrollment that was under way has still stored goes with
it, and a write that comes later finds no tenant.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.orm import InstrumentedAttribute

from templates.store.api_keys import ApiKeys
from templates.store.audit_log import PROGRAM, TENANT_ERASE, By, Entry
from templates.store.context import StoreContext
from templates.store.deployment import insert_once
from templates.store.identifiers import UnknownTenant, checked_tenant_name
from templates.store.receipts import (
    ErasedTenant,
    Receipt,
    keep_receipt,
    latest_receipt,
    tenant_receipt_name,
)
from templates.store.schema import (
    ApiKeyRow,
    Base,
    FailedAttemptsRow,
    RotationKeyRow,
    SubjectRow,
    TemplateRow,
    TenantErasureRow,
    TenantRow,
    UsedNonceRow,
)
from templates.store.subject_rows import subject_lock, tenant_id_of
from templates.store.tenants import AlteredTenant, Tenant, Tenants

BATCH = 200

Counts = dict[str, int]


@dataclass(frozen=True)
class TenantErasure:
    """What :meth:`TenantErasures.erase` did.

    Attributes
    ----------
    receipt
        The signed receipt.
    erased
        Whether this call removed the tenant; False where it was gone already.
    log_purged
        False if SQLite could not empty its write-ahead log just now, as beside a long reader; the
        next erasure or ``purge_log`` does it.
    """

    receipt: Receipt
    erased: bool
    log_purged: bool


@dataclass(frozen=True)
class _Records:
    """One kind of record of a tenant: its table and key, and which rows are the tenant's.

    `more` is what else is read of a row.
    """

    items: Sequence[str]
    table: type[Base]
    key: Sequence[InstrumentedAttribute[Any]]
    owned_by: Callable[[str], sa.ColumnElement[bool]]
    more: Sequence[InstrumentedAttribute[str]] = ()


# Before the row of the tenant, so that they can be counted; a subject's template goes with it.
_IN_BATCHES = (
    _Records(
        ("subjects", "data_keys"),
        SubjectRow,
        [SubjectRow.id],
        lambda tenant_id: SubjectRow.tenant_id == tenant_id,
        [SubjectRow.subject_id],
    ),
    _Records(
        ("failed_attempts",),
        FailedAttemptsRow,
        [FailedAttemptsRow.tenant_id, FailedAttemptsRow.pseudonym],
        lambda tenant_id: FailedAttemptsRow.tenant_id == tenant_id,
    ),
    _Records(
        ("nonces",),
        UsedNonceRow,
        [UsedNonceRow.api_key_id, UsedNonceRow.nonce_hash],
        lambda tenant_id: UsedNonceRow.api_key_id.in_(
            sa.select(ApiKeyRow.id).where(ApiKeyRow.tenant_id == tenant_id)
        ),
    ),
)


class TenantErasures:
    """The only way to erase a tenant."""

    def __init__(self, context: StoreContext, tenants: Tenants, api_keys: ApiKeys) -> None:
        self._context = context
        self._tenants = tenants
        self._api_keys = api_keys

    def erase(
        self,
        tenant: str,
        *,
        by: By = PROGRAM,
        batch: int = BATCH,
        progress: Callable[[int], None] | None = None,
    ) -> TenantErasure:
        """Remove all that is held of a tenant, its keys included; leave one signed receipt.

        It may be interrupted and called again: the call that removes the tenant signs the receipt,
        which counts what all of them removed. Erasing again returns that receipt.

        Parameters
        ----------
        tenant
            Its name. A tenant that is made anew under it later is another one.
        by
            Who asks for it, for the audit log.
        batch
            Records in one transaction.
        progress
            Called after each transaction with the number of records that it removed.

        Raises
        ------
        UnknownTenant
            If there never was a tenant of this name.
        """
        checked_tenant_name(tenant)
        context = self._context
        begun = context.write(lambda connection: self._begin(connection, tenant, by))
        if isinstance(begun, Receipt):
            receipt, erased = begun, False
        else:
            tenant_id = begun
            for records in _IN_BATCHES:
                while removed := self._remove_batch(tenant_id, tenant, records, batch):
                    if progress is not None:
                        progress(removed)
            receipt, erased = context.write_alone(
                lambda connection: self._finish(connection, tenant_id, tenant, by)
            )
        return TenantErasure(receipt, erased, log_purged=context.database.purge_log())

    def held(self, tenant: str) -> ErasedTenant:
        """Count what there is of a tenant now; :class:`UnknownTenant` where there is none."""
        checked_tenant_name(tenant)

        def work(connection: Connection) -> ErasedTenant:
            tenant_id = tenant_id_of(connection, tenant)
            counts = dict.fromkeys(_ITEMS, 0)
            owned: list[tuple[Sequence[str], type[Base], sa.ColumnElement[bool]]] = [
                (records.items, records.table, records.owned_by(tenant_id))
                for records in _IN_BATCHES
            ]
            owned += [
                (["templates"], TemplateRow, _template_of(tenant_id)),
                (["api_keys"], ApiKeyRow, ApiKeyRow.tenant_id == tenant_id),
                (["rotation_keys"], RotationKeyRow, RotationKeyRow.tenant_id == tenant_id),
            ]
            for items, table, condition in owned:
                query = sa.select(sa.func.count()).select_from(table).where(condition)
                counts |= dict.fromkeys(items, connection.execute(query).scalar_one())
            return ErasedTenant(**counts)

        return self._context.database.read(work)

    def receipt(self, tenant: str) -> Receipt | None:
        """Return the latest receipt of the erasure of a tenant of this name, or None."""
        checked_tenant_name(tenant)
        return self._context.database.read(
            lambda connection: latest_receipt(connection, tenant_receipt_name(tenant))
        )

    def _begin(self, connection: Connection, tenant: str, by: By) -> str | Receipt:
        """Revoke the tenant's API keys; returns its row id, or the receipt where it is gone."""
        try:
            tenant_id = tenant_id_of(connection, tenant)
        except UnknownTenant:
            earlier = latest_receipt(connection, tenant_receipt_name(tenant))
            if earlier is None:
                raise
            self._note(connection, "receipt_repeated", tenant, by)
            return earlier
        first = insert_once(
            connection,
            TenantErasureRow,
            tenant_id=tenant_id,
            begun_at=self._context.clock(),
            removed={},
        )
        # Before the first line: the head of the audit log is locked last.
        owner = self._locked(connection, tenant) if first else None
        self._api_keys.revoke_all(connection, tenant, by=by)
        if owner is None:
            self._note(connection, "begun" if first else "resumed", tenant, by)
        else:
            # Its row stays good until it goes: writes that are under way need it.
            self._tenants.change(connection, owner, Entry(TENANT_ERASE, "begun", by, tenant))
        return tenant_id

    def _locked(self, connection: Connection, tenant: str) -> Tenant | None:
        """Return the tenant; None where its row is not authentic, and so must not be renewed."""
        try:
            return self._tenants.locked(connection, tenant)
        except AlteredTenant:
            return None

    def _remove_batch(self, tenant_id: str, tenant: str, records: _Records, batch: int) -> int:
        def work(connection: Connection) -> int:
            rows = self._rows(connection, tenant_id, tenant, records, batch)
            counts = _remove(connection, records, rows)
            if any(counts.values()):
                _add(connection, tenant_id, counts)
            return sum(counts.values())

        # The lock is for the count, should the same tenant be erased twice at once.
        return self._context.write(work, lock=f"tenant erasure {tenant_id}")

    def _finish(
        self, connection: Connection, tenant_id: str, tenant: str, by: By
    ) -> tuple[Receipt, bool]:
        epoch = connection.execute(
            sa.select(TenantRow.rotation_epoch).where(TenantRow.id == tenant_id)
        ).scalar_one_or_none()
        if epoch is None:  # another call was faster
            earlier = latest_receipt(connection, tenant_receipt_name(tenant))
            assert earlier is not None, "only the last transaction removes a tenant"  # noqa: S101
            return earlier, False
        for records in _IN_BATCHES:
            rows = self._rows(connection, tenant_id, tenant, records, None)
            _add(connection, tenant_id, _remove(connection, records, rows))
        for item, table in (("api_keys", ApiKeyRow), ("rotation_keys", RotationKeyRow)):
            gone = connection.execute(sa.delete(table).where(table.tenant_id == tenant_id))
            _add(connection, tenant_id, {item: gone.rowcount})
        removed = connection.execute(
            sa.select(TenantErasureRow.removed).where(TenantErasureRow.tenant_id == tenant_id)
        ).scalar_one()
        connection.execute(
            sa.delete(TenantErasureRow).where(TenantErasureRow.tenant_id == tenant_id)
        )
        connection.execute(sa.delete(TenantRow).where(TenantRow.id == tenant_id))
        now = self._context.clock()
        receipt = self._context.signer.sign_tenant(
            tenant=tenant,
            rotation_epoch=epoch,
            erased=ErasedTenant(**{**dict.fromkeys(_ITEMS, 0), **removed}),
            erased_at=now,
        )
        keep_receipt(connection, tenant_receipt_name(tenant), receipt, now)
        self._note(connection, "erased", tenant, by)
        return receipt, True

    def _rows(
        self,
        connection: Connection,
        tenant_id: str,
        tenant: str,
        records: _Records,
        batch: int | None,
    ) -> Sequence[Any]:
        """Rows of a batch of records that no other write is at; of all of them without a number.

        Those that are in use are left to a later batch, or to the last transaction: waiting for
        them, in whatever order they come, could make a deadlock.
        """
        query = (
            sa.select(*records.key, *records.more)
            .where(records.owned_by(tenant_id))
            .order_by(*records.key)
            .limit(batch)
            .with_for_update(skip_locked=True)
        )
        rows = connection.execute(query).all()
        if records.table is not SubjectRow or batch is None:
            return rows
        locks = [subject_lock(tenant, row.subject_id) for row in rows]
        free: list[bool] = []
        for start in range(0, len(rows), BATCH):
            free += self._context.database.try_locks(connection, locks[start : start + BATCH])
        return [row for row, is_free in zip(rows, free, strict=True) if is_free]

    def _note(self, connection: Connection, outcome: str, tenant: str, by: By) -> None:
        entry = Entry(TENANT_ERASE, outcome, by, tenant)
        self._context.audit_log.append(connection, entry)


_ITEMS = tuple(item.name for item in fields(ErasedTenant))


def _remove(connection: Connection, records: _Records, rows: Sequence[Any]) -> Counts:
    counts: Counts = {}
    for start in range(0, len(rows), BATCH):  # a statement has a bounded number of parameters
        some = rows[start : start + BATCH]
        if records.table is SubjectRow:
            templates = sa.delete(TemplateRow).where(
                TemplateRow.subject_pk.in_([row.id for row in some])
            )
            _count(counts, ["templates"], connection.execute(templates).rowcount)
        keys = [tuple(row._mapping[column.key] for column in records.key) for row in some]
        statement = sa.delete(records.table).where(sa.tuple_(*records.key).in_(keys))
        _count(counts, records.items, connection.execute(statement).rowcount)
    return counts


def _add(connection: Connection, tenant_id: str, counts: Counts) -> None:
    """Add to what the erasure of the tenant has removed so far."""
    of_tenant = TenantErasureRow.tenant_id == tenant_id
    query = sa.select(TenantErasureRow.removed).where(of_tenant)
    removed: Counts = dict(connection.execute(query).scalar_one_or_none() or {})
    for item, count in counts.items():
        _count(removed, [item], count)
    connection.execute(sa.update(TenantErasureRow).where(of_tenant).values(removed=removed))


def _count(counts: Counts, items: Sequence[str], count: int) -> None:
    for item in items:
        counts[item] = counts.get(item, 0) + count


def _template_of(tenant_id: str) -> sa.ColumnElement[bool]:
    subjects = sa.select(SubjectRow.id).where(SubjectRow.tenant_id == tenant_id)
    return TemplateRow.subject_pk.in_(subjects)
