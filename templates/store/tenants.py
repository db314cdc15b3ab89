"""Tenants, and the key of each one's rotations.

A tenant's name and an epoch name one key for ever: the epochs of a tenant that is made anew, after
one of its name was erased, go on where those ended. So a process that keeps keys in memory, and an
enrollment that was under way, cannot mistake one for the other.
"""

import os
import uuid
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import sealed_key_id
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import UnknownTenant, checked_tenant_name
from templates.store.receipts import latest_receipt, tenant_receipt_name, verify_receipt
from templates.store.schema import RotationKeyRow, TenantRow

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
    """The secret that a tenant's rotations derive from (``templates.keys.rotation``)."""

    epoch: int
    key: bytes = field(repr=False)


class RetiredRotation(UnknownTenant):
    """The key of this epoch is gone; its templates were moved. Read the template again."""


class Tenants:
    """Repository of tenants."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def create(self, name: str) -> Tenant:
        """Return the tenant of this name, which is made, with its rotation key, if it is new."""
        checked_tenant_name(name)
        return self._context.database.write(lambda connection: self.ensure(connection, name))

    def ensure(self, connection: Connection, name: str) -> Tenant:
        """:meth:`create` inside a write."""
        row = connection.execute(_TENANTS.where(TenantRow.name == name)).one_or_none()
        if row is not None:
            return Tenant(**row._mapping)
        tenant = Tenant(
            id=uuid.uuid4().hex,
            name=name,
            rotation_epoch=1 + self._last_epoch_of_erased(connection, name),
            created_at=self._context.clock(),
            template_enrollment=False,
        )
        connection.execute(sa.insert(TenantRow).values(vars(tenant)))
        self.add_rotation_key(connection, tenant.id, tenant.rotation_epoch)
        return tenant

    def get(self, name: str) -> Tenant:
        """Return a tenant, or raise :class:`UnknownTenant`."""
        return self._context.database.read(lambda connection: tenant_of(connection, name))

    def all(self) -> tuple[Tenant, ...]:
        """Every tenant, by name."""
        query = _TENANTS.order_by(TenantRow.name)
        rows = self._context.database.read(lambda connection: connection.execute(query).all())
        return tuple(Tenant(**row._mapping) for row in rows)

    def set_template_enrollment(self, name: str, allowed: bool, *, by: By = PROGRAM) -> Tenant:
        """Allow clients of a tenant to enroll templates that they made themselves, or forbid it."""
        outcome = "template-enrollment-on" if allowed else "template-enrollment-off"
        entry = Entry("tenant-settings", outcome, by, checked_tenant_name(name))

        def work(connection: Connection) -> Tenant:
            tenant = tenant_of(connection, name)
            change = sa.update(TenantRow).where(TenantRow.id == tenant.id)
            connection.execute(change.values(template_enrollment=allowed))
            self._context.audit_log.append(connection, entry)
            return tenant_of(connection, name)

        return self._context.database.write(work)

    def rotation_key(self, name: str, *, epoch: int | None = None) -> RotationKey:
        """Open the rotation key of a tenant, of the current epoch unless another is asked for.

        Raises
        ------
        UnknownTenant
        RetiredRotation
            Where there is no key of this epoch any more.
        """
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
        """Draw the key of a new epoch inside a write."""
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

    def _last_epoch_of_erased(self, connection: Connection, name: str) -> int:
        """Last epoch of the latest tenant of this name that was erased, by its receipt; else 0."""
        receipt = latest_receipt(connection, tenant_receipt_name(name))
        if receipt is None:
            return 0
        claims = verify_receipt(receipt, self._context.signer.public_key())
        if claims.get("tenant") != name or "rotation_epoch" not in claims:
            raise StoreError("the receipt of this tenant's erasure was put in another's place")
        return int(claims["rotation_epoch"])


def tenant_of(connection: Connection, name: str) -> Tenant:
    """Read a tenant, or raise :class:`UnknownTenant`."""
    row = connection.execute(_OF_NAME, {"name": name}).one_or_none()
    if row is None:
        raise UnknownTenant.of_name(name)
    return Tenant(**row._mapping)


_TENANTS: Any = sa.select(*(getattr(TenantRow, name) for name in Tenant.__dataclass_fields__))
_OF_NAME = _TENANTS.where(TenantRow.name == sa.bindparam("name"))
