"""Tenants, and the key of each one's rotations.

A tenant's name and an epoch name one key for ever: the epochs of a tenant that is made anew, after
one of its name was erased, go on where those ended. So a process that keeps keys in memory, and an
enrollment that was under way, cannot mistake one for the other.
"""

import os
import uuid
from collections.abc import Sequence

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import UnknownTenant, checked_tenant_name
from templates.store.receipts import latest_receipt, tenant_receipt_name, verify_receipt
from templates.store.schema import RotationKeyRow, TenantRow

ROTATION_PURPOSE = "tenant-rotation-key"


class RetiredRotation(UnknownTenant):
    """The key of this epoch is gone; its templates were moved. Read the template again."""


class Tenants:
    """Repository of tenants."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def create(self, name: str) -> TenantRow:
        """Return the tenant of this name, which is made, with its rotation key, if it is new."""
        checked_tenant_name(name)
        with self._context.database.write() as session:
            tenant = session.scalars(_OF_NAME, {"name": name}).one_or_none()
            if tenant is None:
                tenant = TenantRow(
                    id=uuid.uuid4().hex,
                    name=name,
                    rotation_epoch=1 + self._last_epoch_of_erased(session, name),
                    template_enrollment=False,
                )
                session.add(tenant)
                session.flush()
                self.add_rotation_key(session, tenant)
            return tenant

    def get(self, name: str) -> TenantRow:
        """Return a tenant, or raise :class:`UnknownTenant`."""
        with self._context.database.read() as session:
            return tenant_of(session, name)

    def all(self) -> Sequence[TenantRow]:
        """Every tenant, by name."""
        with self._context.database.read() as session:
            return session.scalars(sa.select(TenantRow).order_by(TenantRow.name)).all()

    def set_template_enrollment(self, name: str, allowed: bool, *, by: By = PROGRAM) -> None:
        """Allow clients of a tenant to enroll templates that they made themselves, or forbid it."""
        outcome = "template-enrollment-on" if allowed else "template-enrollment-off"
        with self._context.database.write() as session:
            tenant_of(session, name).template_enrollment = allowed
            self._context.audit_log.append(session, Entry("tenant-settings", outcome, by, name))

    def rotation_key(self, name: str, epoch: int) -> bytes:
        """Return the secret that the rotations of a tenant's epoch derive from.

        :class:`RetiredRotation` where the epoch has none any more.
        """
        with self._context.database.read() as session:
            tenant = tenant_of(session, name)
            row = session.get(RotationKeyRow, (tenant.id, epoch))
        if row is None:
            raise RetiredRotation(f"tenant {name!r} has no rotation key of epoch {epoch}")
        return self._context.keyring.open(
            row.wrapped_key, purpose=ROTATION_PURPOSE, bound_to=[tenant.id, epoch]
        )

    def add_rotation_key(self, session: Session, tenant: TenantRow) -> None:
        """Draw the key of a tenant's current epoch, a new one, in a write."""
        epoch = tenant.rotation_epoch
        wrapped = self._context.keyring.seal(
            os.urandom(32), purpose=ROTATION_PURPOSE, bound_to=[tenant.id, epoch]
        )
        session.add(RotationKeyRow(tenant_id=tenant.id, epoch=epoch, wrapped_key=wrapped))

    def _last_epoch_of_erased(self, session: Session, name: str) -> int:
        """Last epoch of the latest tenant of this name that was erased, by its receipt; else 0."""
        receipt = latest_receipt(session, tenant_receipt_name(name))
        if receipt is None:
            return 0
        claims = verify_receipt(receipt, self._context.signer.public_key())
        if claims.get("tenant") != name or "rotation_epoch" not in claims:
            raise StoreError("the receipt of this tenant's erasure was put in another's place")
        return int(claims["rotation_epoch"])


def tenant_of(session: Session, name: str) -> TenantRow:
    """Read a tenant, or raise :class:`UnknownTenant`."""
    tenant = session.scalars(_OF_NAME, {"name": name}).one_or_none()
    if tenant is None:
        raise UnknownTenant(f"there is no tenant {name!r}")
    return tenant


_OF_NAME = sa.select(TenantRow).where(TenantRow.name == sa.bindparam("name"))
