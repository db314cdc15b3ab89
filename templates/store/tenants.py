"""Tenants, and the key of each one's rotation.

A tenant's name and an epoch name one rotation for ever: the epochs of a tenant that is made anew,
after one of its name was erased, go on where those ended. So a process that keeps rotations in
memory, and an enrollment that was under way, cannot mistake one for the other.
"""

import json
import os
import uuid
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.sealing import MasterKeyring, sealed_key_id
from templates.store.database import Database
from templates.store.deployment import insert_once
from templates.store.identifiers import Clock, UnknownTenant, checked_tenant_name
from templates.store.receipts import tenant_receipt_name
from templates.store.schema import ReceiptRow, RotationKeyRow, TenantRow

ROTATION_PURPOSE = "tenant-rotation-key"


@dataclass(frozen=True)
class Tenant:
    """A tenant; `rotation_epoch` is the epoch whose key new templates are rotated with."""

    id: str
    name: str
    rotation_epoch: int
    created_at: datetime


@dataclass(frozen=True)
class RotationKey:
    """The secret that a tenant's rotation is drawn from (``templates.rotation``)."""

    epoch: int
    key: bytes = field(repr=False)


class RetiredRotation(UnknownTenant):
    """No rotation of this epoch any more: what was read in it was moved on since, read it again."""


class Tenants:
    """Repository of tenants."""

    def __init__(self, database: Database, keyring: MasterKeyring, clock: Clock) -> None:
        self._database = database
        self._keyring = keyring
        self._clock = clock

    def create(self, name: str) -> Tenant:
        """Return the tenant of this name, which is made, with its rotation key, if it is new."""
        checked_tenant_name(name)
        return self._database.write(lambda each: self.ensure(each, name))

    def ensure(self, connection: Connection, name: str) -> Tenant:
        """:meth:`create` inside a transaction that is open already."""
        tenant_id, now = uuid.uuid4().hex, self._clock()
        epoch = 1 + _last_epoch_of_erased(connection, name)
        made = insert_once(
            connection, TenantRow, id=tenant_id, name=name, rotation_epoch=epoch, created_at=now
        )
        if made:
            self.add_rotation_key(connection, tenant_id, epoch)
        return _tenant(connection.execute(_COLUMNS.where(TenantRow.name == name)).one())

    def get(self, name: str) -> Tenant:
        """Return a tenant, or raise :class:`UnknownTenant`."""
        row = self._database.read(
            lambda each: each.execute(_COLUMNS.where(TenantRow.name == name)).one_or_none()
        )
        if row is None:
            raise UnknownTenant(f"there is no tenant {checked_tenant_name(name)!r}")
        return _tenant(row)

    def all(self) -> tuple[Tenant, ...]:
        """Every tenant, by name."""
        rows = self._database.read(
            lambda each: each.execute(_COLUMNS.order_by(TenantRow.name)).all()
        )
        return tuple(_tenant(row) for row in rows)

    def rotation_key(self, name: str, *, epoch: int | None = None) -> RotationKey:
        """Open the rotation key of a tenant, of the current epoch unless another is asked for."""
        tenant = self.get(name)
        epoch = tenant.rotation_epoch if epoch is None else epoch
        wrapped = self._database.read(
            lambda each: each.execute(
                sa.select(RotationKeyRow.wrapped_key).where(
                    RotationKeyRow.tenant_id == tenant.id, RotationKeyRow.epoch == epoch
                )
            ).scalar_one_or_none()
        )
        if wrapped is None:
            raise RetiredRotation(f"tenant {name!r} has no rotation of epoch {epoch}")
        key = self._keyring.open(wrapped, purpose=ROTATION_PURPOSE, bound_to=[tenant.id, epoch])
        return RotationKey(epoch=epoch, key=key)

    def add_rotation_key(self, connection: Connection, tenant_id: str, epoch: int) -> None:
        """Draw the key of a new epoch inside a transaction that is open already."""
        wrapped = self._keyring.seal(
            os.urandom(32), purpose=ROTATION_PURPOSE, bound_to=[tenant_id, epoch]
        )
        connection.execute(
            sa.insert(RotationKeyRow).values(
                tenant_id=tenant_id,
                epoch=epoch,
                wrapped_key=wrapped,
                wrapping_key=sealed_key_id(wrapped),
                created_at=self._clock(),
            )
        )


_COLUMNS = sa.select(TenantRow.id, TenantRow.name, TenantRow.rotation_epoch, TenantRow.created_at)


def _last_epoch_of_erased(connection: Connection, name: str) -> int:
    """Last epoch of the latest tenant of this name that was erased, by its receipt; else 0."""
    body = connection.execute(
        sa.select(ReceiptRow.body)
        .where(ReceiptRow.pseudonym == tenant_receipt_name(name))
        .order_by(ReceiptRow.sequence.desc())
        .limit(1)
    ).scalar_one_or_none()
    return 0 if body is None else int(json.loads(body)["rotation_epoch"])


def _tenant(row: Any) -> Tenant:
    return Tenant(*row)
