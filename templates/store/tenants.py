"""Tenants, and the key of each one's rotations.

A tenant's name and an epoch name one key for ever: the epochs of a tenant that is made anew,
after one of its name was erased, go on where those ended. So a process that keeps keys in
memory, and an enrollment that was under way, cannot mistake one for the other.
"""

import os
import uuid
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.keys.sealing import sealed_key_id
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.authenticity import (
    LAST_TENANT_LINE,
    columns_of,
    is_current,
    last_line,
    row_mac,
    warn,
)
from templates.store.context import StoreContext
from templates.store.deployment import insert_once
from templates.store.identifiers import UnknownTenant, checked_tenant_name
from templates.store.receipts import latest_receipt, tenant_receipt_name
from templates.store.schema import TENANT_LINES, AuditRow, RotationKeyRow, TenantRow

ROTATION_PURPOSE = "tenant-rotation-key"


@dataclass(frozen=True)
class Tenant:
    """A tenant.

    Attributes
    ----------
    rotation_epoch
        Epoch whose key new templates are turned by.
    template_enrollment
        Whether clients may enroll templates that they made themselves.
    """

    id: str
    name: str
    rotation_epoch: int
    created_at: datetime
    template_enrollment: bool


@dataclass(frozen=True)
class RotationKey:
    """The secret that the rotations of a tenant's templates derive from.

    See ``templates.keys.rotation``.
    """

    epoch: int
    key: bytes = field(repr=False)


class AlteredTenant(UnknownTenant):
    """The row of the tenant is not as this program left it, so it is as good as none."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"the row of tenant {name!r} was altered in the database, or put back to an earlier "
            "state: run `veilface audit-log verify`, and restore the database from a backup"
        )


class RetiredRotation(UnknownTenant):
    """No key of this epoch any more: what was read in it was moved on since, read it again."""


class Tenants:
    """Repository of tenants."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def create(self, name: str) -> Tenant:
        """Return the tenant of this name, which is made, with its rotation key, if it is new."""
        checked_tenant_name(name)
        return self._context.write(lambda connection: self.ensure(connection, name))

    def ensure(self, connection: Connection, name: str) -> Tenant:
        """:meth:`create` inside a transaction that is open already, its log prepared."""
        tenant = Tenant(
            id=uuid.uuid4().hex,
            name=name,
            rotation_epoch=1 + _last_epoch_of_erased(connection, name),
            created_at=self._context.clock(),
            template_enrollment=False,
        )
        # An erased tenant of this name has left lines, and a row from before them is none of ours.
        line = connection.execute(_LAST_LINE, {"name": name}).scalar() or 0
        if insert_once(connection, TenantRow, **self._row(tenant, line)):
            self.add_rotation_key(connection, tenant.id, tenant.rotation_epoch)
        return self._one(connection, name)

    def get(self, name: str) -> Tenant:
        """Return a tenant.

        Raises
        ------
        UnknownTenant
            Where there is none; :class:`AlteredTenant` where its row is not authentic.
        """
        return self._context.read(lambda connection: self._one(connection, name))

    def all(self) -> tuple[Tenant, ...]:
        """Every tenant, by name; without those whose row is not authentic."""
        query = _ROWS.order_by(TenantRow.name)
        rows = self._context.read(lambda connection: connection.execute(query).all())
        return tuple(_tenant(row) for row in rows if self._is_current(row))

    def set_template_enrollment(self, name: str, allowed: bool, *, by: By = PROGRAM) -> Tenant:
        """Allow clients of a tenant to enroll templates that they made themselves, or forbid it.

        Raises
        ------
        UnknownTenant
        """
        outcome = "template-enrollment-on" if allowed else "template-enrollment-off"
        entry = Entry("tenant-settings", outcome, by, checked_tenant_name(name))

        def work(connection: Connection) -> Tenant:
            tenant = self.locked(connection, name)
            return self.change(connection, tenant, entry, template_enrollment=allowed)

        return self._context.write(work)

    def locked(self, connection: Connection, name: str) -> Tenant:
        """Return a tenant, whose row no other transaction changes until this one ends.

        Raises
        ------
        UnknownTenant
            As :meth:`get`.
        """
        return self._one(connection, name, for_update=True)

    def change(
        self, connection: Connection, tenant: Tenant, entry: Entry, **columns: Any
    ) -> Tenant:
        """Change columns of a tenant that is :meth:`locked`, and add the line that tells of it."""
        changed = replace(tenant, **columns)
        line = self._context.audit_log.append(connection, entry)
        connection.execute(
            sa.update(TenantRow).where(TenantRow.id == tenant.id).values(self._row(changed, line))
        )
        return changed

    def _one(self, connection: Connection, name: str, *, for_update: bool = False) -> Tenant:
        query = _ROWS.where(TenantRow.name == name)
        if for_update:
            query = query.with_for_update(of=TenantRow, key_share=True)
        row = connection.execute(query).one_or_none()
        if row is None:
            raise UnknownTenant.named(checked_tenant_name(name))
        if not self._is_current(row):
            warn("a tenant's row is not authentic and was passed over", tenant=name)
            raise AlteredTenant(name)
        return _tenant(row)

    def _is_current(self, row: Any) -> bool:
        return is_current(self._context.audit_log.row_key(), TenantRow, row._mapping)

    def _row(self, tenant: Tenant, line: int) -> dict[str, Any]:
        row = {**vars(tenant), "line": line}
        return {**row, "mac": row_mac(self._context.audit_log.row_key(), TenantRow, row)}

    def rotation_key(self, name: str, *, epoch: int | None = None) -> RotationKey:
        """Open the rotation key of a tenant, of the current epoch unless another is asked for."""
        tenant = self.get(name)
        epoch = tenant.rotation_epoch if epoch is None else epoch
        query = sa.select(RotationKeyRow.wrapped_key).where(
            RotationKeyRow.tenant_id == tenant.id, RotationKeyRow.epoch == epoch
        )
        wrapped = self._context.database.read(
            lambda connection: connection.execute(query).scalar_one_or_none()
        )
        if wrapped is None:
            raise RetiredRotation(f"tenant {name!r} has no rotation key of epoch {epoch}")
        key = self._context.keyring.open(
            wrapped, purpose=ROTATION_PURPOSE, bound_to=[tenant.id, epoch]
        )
        return RotationKey(epoch=epoch, key=key)

    def add_rotation_key(self, connection: Connection, tenant_id: str, epoch: int) -> None:
        """Draw the key of a new epoch inside a transaction that is open already."""
        wrapped = self._context.keyring.seal(
            os.urandom(32), purpose=ROTATION_PURPOSE, bound_to=[tenant_id, epoch]
        )
        connection.execute(
            sa.insert(RotationKeyRow).values(
                tenant_id=tenant_id,
                epoch=epoch,
                wrapped_key=wrapped,
                wrapping_key=sealed_key_id(wrapped),
                created_at=self._context.clock(),
            )
        )


_ROWS: Any = sa.select(*columns_of(TenantRow), LAST_TENANT_LINE.label("last_line"))
_LAST_LINE = last_line(AuditRow.tenant == sa.bindparam("name"), TENANT_LINES)


def _last_epoch_of_erased(connection: Connection, name: str) -> int:
    """Last epoch of the latest tenant of this name that was erased, by its receipt; else 0."""
    receipt = latest_receipt(connection, tenant_receipt_name(name))
    return 0 if receipt is None else int(receipt.claims["rotation_epoch"])


def _tenant(row: Any) -> Tenant:
    return Tenant(**{name: getattr(row, name) for name in Tenant.__dataclass_fields__})
