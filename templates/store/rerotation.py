"""Renewing a tenant's rotations: a new epoch, templates moved into it, and the old keys dropped.

::

    begin    a new key; templates are enrolled in the new epoch from now on, both are verified
    move     stored templates of older epochs into the current one, beside a service in use
    retire   the keys of the older epochs go, when nothing needs them

A template of the old rotation R is turned by R' Rᵀ, which is R' x for every x that was R x, so
nobody has to enroll again. Its id stays, and with the new key gives another rotation. It protects
what is stored from now on. A copy of the database that was taken before, with its rotation key and
master key, keeps what it had.

Each move rounds to the stored precision once more: as much as the first rounding costs, in half
precision 1.3·10⁻⁵ of a distance in the root mean square (docs/results/deployment.md).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.contract import wire
from templates.contract.binding import Binding
from templates.errors import InvalidTemplate, SealError, StoreError, TemplateError
from templates.keys.rotation import TenantRotation
from templates.keys.sealing import sealed_key_id
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.envelope import close_envelope
from templates.store.schema import RotationKeyRow, SubjectRow, TemplateRow, TenantRow
from templates.store.subject_rows import TEMPLATE_COLUMNS, opened_template, owner_of
from templates.store.tenants import RetiredRotation, Tenant, Tenants, tenant_of

ACTION = "tenant-rotate"
BATCH = 10


class Rerotation:
    """Renews the rotations of tenants' templates."""

    def __init__(self, context: StoreContext, tenants: Tenants) -> None:
        self._context = context
        self._tenants = tenants

    def begin(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Make a new key, under which templates are enrolled from now on; returns its epoch.

        Stored templates stay under theirs until :meth:`move` has seen them.
        """

        def work(connection: Connection) -> int:
            owner = tenant_of(connection, tenant)
            epoch = owner.rotation_epoch + 1
            self._tenants.add_rotation_key(connection, owner.id, epoch)
            change = sa.update(TenantRow).where(TenantRow.id == owner.id)
            connection.execute(change.values(rotation_epoch=epoch))
            self._note(connection, "begun", tenant, epoch, by)
            return epoch

        return self._context.database.write(work)

    def move(
        self,
        tenant: str,
        binding: Binding,
        *,
        batch: int = BATCH,
        progress: Callable[[int], None] | None = None,
        by: By = PROGRAM,
    ) -> int:
        """Bring stored templates of older epochs into the current one; returns how many.

        Template id, metadata and times stay; the data key is a new one. It may be interrupted, run
        again, and run by several processes at once, beside a service in use: each transaction, for
        which every other write waits, takes `batch` templates. Those of another contract than the
        binding's are left to be enrolled again.

        `progress` is called after each transaction with the number of templates that it moved. The
        audit log gets one line at the end, if anything was moved. :class:`StoreError` then, if rows
        do not open or hold no template; all others are moved.
        """
        database, total, broken, after = self._context.database, 0, 0, ""
        rotations = _Rotations(self._tenants, tenant, binding)
        while True:
            moved, failed, after = database.write(
                lambda connection, after=after: self._move_batch(  # type: ignore[misc]
                    connection, rotations, after, batch
                )
            )
            if not moved + failed:
                break
            total, broken = total + moved, broken + failed
            if progress is not None and moved:
                progress(moved)
        epoch = self._tenants.get(tenant).rotation_epoch
        database.purge_log()
        if total:
            database.write(lambda connection: self._note(connection, "moved", tenant, epoch, by))
        if broken:
            raise StoreError(
                f"{broken} templates of tenant {tenant!r} could not be moved to its new "
                "rotation: their rows were altered, or a master key is missing. Put the key back "
                "and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def remaining(self, tenant: str) -> int:
        """Number of the tenant's templates that are not in its current epoch."""
        return self._context.database.read(
            lambda connection: _count_older(connection, tenant_of(connection, tenant))
        )

    def subjects_of_old_epochs(self, tenant: str) -> list[str]:
        """Ids, in order, of the subjects whose templates are not in the current epoch."""

        def work(connection: Connection) -> list[str]:
            query = (
                sa.select(SubjectRow.subject_id)
                .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
                .where(_is_older(tenant_of(connection, tenant)))
                .order_by(SubjectRow.subject_id)
            )
            return list(connection.execute(query).scalars())

        return self._context.database.read(work)

    def retire(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Drop the keys of all epochs but the current one; returns how many.

        :class:`StoreError` if templates of older epochs are left.
        """

        def work(connection: Connection) -> int:
            owner = tenant_of(connection, tenant)
            if left := _count_older(connection, owner):
                raise StoreError(
                    f"{left} templates of tenant {tenant!r} are still in an older rotation: "
                    "move them first, and enroll again the subjects that cannot be moved"
                )
            older = sa.delete(RotationKeyRow).where(
                RotationKeyRow.tenant_id == owner.id, RotationKeyRow.epoch < owner.rotation_epoch
            )
            dropped = connection.execute(older).rowcount
            if dropped:
                self._note(connection, "retired", tenant, owner.rotation_epoch, by)
            return dropped

        dropped = self._context.database.write(work)
        self._context.database.purge_log()
        return dropped

    def _note(self, connection: Connection, outcome: str, tenant: str, epoch: int, by: By) -> None:
        entry = Entry(ACTION, outcome, by, tenant, detail=f"epoch {epoch}")
        self._context.audit_log.append(connection, entry)

    def _move_batch(
        self, connection: Connection, rotations: "_Rotations", after: str, batch: int
    ) -> tuple[int, int, str]:
        """Turn the templates after a row; returns how many, how many failed, and the last row."""
        owner = tenant_of(connection, rotations.tenant)
        query = (
            sa.select(*TEMPLATE_COLUMNS)
            .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
            .where(_is_older(owner), TemplateRow.contract_id == rotations.binding.contract_id)
            .where(SubjectRow.id > after)
            .order_by(SubjectRow.id)
            .limit(batch)
        )
        moved = broken = 0
        for row in connection.execute(query).all():
            after = row.subject_pk
            try:
                wire = opened_template(row, self._context.keyring).wire
                turned = rotations.turned(row, wire, owner.rotation_epoch)
            except (SealError, TemplateError, RetiredRotation):
                broken += 1
                continue
            self._replace(connection, row, turned, owner.rotation_epoch)
            moved += 1
        return moved, broken, after

    def _replace(self, connection: Connection, row: Any, turned: bytes, epoch: int) -> None:
        new = close_envelope(
            turned, replace(owner_of(row), rotation_epoch=epoch), self._context.keyring
        )
        connection.execute(
            sa.update(SubjectRow)
            .where(SubjectRow.id == row.subject_pk)
            .values(wrapped_key=new.wrapped_key, wrapping_key=sealed_key_id(new.wrapped_key))
        )
        connection.execute(
            sa.update(TemplateRow)
            .where(TemplateRow.subject_pk == row.subject_pk)
            .values(rotation_epoch=epoch, ciphertext=new.ciphertext)
        )


class _Rotations:
    """The rotations of one tenant and contract, by epoch."""

    def __init__(self, tenants: Tenants, tenant: str, binding: Binding) -> None:
        self.tenant = tenant
        self.binding = binding
        self._tenants = tenants
        self._of_epochs: dict[int, TenantRotation] = {}

    def turned(self, row: Any, stored: bytes, epoch: int) -> bytes:
        """Turn the wire bytes of a row's template as the contract's templates of an epoch are."""
        binding, template = self.binding, wire.decode(stored)
        shape = template.subspace.n, template.subspace.m
        if template.contract_id != row.contract_id or shape != (binding.axes, binding.m):
            raise InvalidTemplate("a stored template is not of the contract that its row names")
        old = self._rotation(row.rotation_epoch).of(row.template_id)
        new = self._rotation(epoch).of(row.template_id)
        turned = template.subspace.turned_by(lambda points: new.turned(old.turned_back(points)))
        return wire.encode(turned, contract_id=binding.contract_id, dtype=template.dtype)

    def _rotation(self, epoch: int) -> TenantRotation:
        if epoch not in self._of_epochs:
            key = self._tenants.rotation_key(self.tenant, epoch=epoch).key
            self._of_epochs[epoch] = TenantRotation(key, self.binding.axes)
        return self._of_epochs[epoch]


def _is_older(owner: Tenant) -> sa.ColumnElement[bool]:
    return sa.and_(
        SubjectRow.tenant_id == owner.id, TemplateRow.rotation_epoch < owner.rotation_epoch
    )


def _count_older(connection: Connection, owner: Tenant) -> int:
    query = (
        sa.select(sa.func.count())
        .select_from(SubjectRow)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .where(_is_older(owner))
    )
    return int(connection.execute(query).scalar_one())
