"""Renewing a tenant's rotations: a new epoch, templates moved into it, and the old keys dropped.

::

    begin    a new key; templates are enrolled in the new epoch from now on, both are verified
    move     stored templates of older epochs into the current one, beside a service in use
    retire   the keys of the older epochs go, when nothing needs them

A template of the old rotation R is turned by R' Rᵀ, which is R' x for every x that was R x, so
nobody has to enroll again. Its id stays, and with the new key gives another rotation. It protects
what is stored from now on. A copy of the database that was taken before, with its rotation key and
master key, keeps what it had.

Each move rounds to the stored precision once more. In half precision at n = 512 and m = 16 the
distance of a probe to the template then differs from the one before by 1.3·10⁻⁵ in the root mean
square, and by 8·10⁻⁵ at most over 400,000 pairs: as much as the first rounding costs
(``tests/templates/store/test_rerotation.py``). They add up like independent errors: after three
moves the distance is 2.6·10⁻⁵ from that to the template before any rounding.

A template of another contract is not turned: it stays in its epoch, whose key is kept until the
subject is enrolled again or erased.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
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
from templates.store.envelope import Owner, close_envelope, open_envelope
from templates.store.schema import RotationKeyRow, SubjectRow, TemplateRow, TenantRow
from templates.store.subject_rows import TEMPLATE_COLUMNS, envelope_of, owner_of
from templates.store.tenants import RetiredRotation, Tenants

ACTION = "tenant-rotate"
BATCH = 50
_PAUSE_S = 0.05


@dataclass(frozen=True)
class _Rotated:
    """A template in the new epoch, and the row that it replaces, with ``TEMPLATE_COLUMNS``."""

    row: Any = field(repr=False)
    owner: Owner
    wire: bytes = field(repr=False)


class Rerotation:
    """Renews the rotations of tenants' templates."""

    def __init__(self, context: StoreContext, tenants: Tenants) -> None:
        self._context = context
        self._tenants = tenants

    def begin(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Make a new key, under which templates are enrolled from now on; returns its epoch.

        Stored templates stay under theirs until :meth:`move` has seen them.

        Raises
        ------
        UnknownTenant
        """

        def work(connection: Connection) -> int:
            owner = self._tenants.locked(connection, tenant)
            epoch = owner.rotation_epoch + 1
            self._tenants.add_rotation_key(connection, owner.id, epoch)
            entry = _entry("begun", tenant, epoch, by)
            self._tenants.change(connection, owner, entry, rotation_epoch=epoch)
            return epoch

        return self._context.write(work)

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

        Template id, metadata and times stay; the data key is a new one. A subject that is enrolled
        or erased meanwhile is left as it is. It may be interrupted, run again, and run by several
        processes at once.

        Parameters
        ----------
        tenant
            Whose templates.
        binding
            Of the contract that they belong to. Templates of any other are left to be enrolled
            again.
        batch
            Templates in one transaction, and in memory.
        progress
            Called after each transaction with the number of templates that it moved.
        by
            Who moves, for the audit log: it gets one line at the end, if anything was moved.

        Raises
        ------
        UnknownTenant
        StoreError
            At the end, if templates do not open or are none: :meth:`subjects_of_old_epochs` names
            their subjects, which must be enrolled again or erased. All others are moved.
        StoreUnavailable
            If a write that was under way at the start does not end within the timeout.
        """
        owner, database = self._tenants.get(tenant), self._context.database
        # An enrollment that read the epoch before the renewal may commit into the old one still.
        database.await_writers()
        rotations = _Rotations(self._tenants, tenant, binding)
        total, broken = 0, set[str]()
        while True:
            moved, left, after = 0, 0, ""
            broken_before, broken = broken, set()
            while rows := database.read(
                partial(_old_templates, owner.id, binding.contract_id, after, batch)
            ):
                after = rows[-1].subject_pk
                rotated = self._rotate_all(rotations, rows, broken)
                changed = database.write(partial(self._replace_all, rotated=rotated))
                moved, left = moved + changed, left + len(rotated) - changed
                if progress is not None and changed:
                    progress(changed)
            total += moved
            # What did not open may have been half seen: only what fails twice is broken.
            if not left and broken <= broken_before:
                break
            if not moved:
                time.sleep(_PAUSE_S)  # another write holds them
        database.purge_log()
        if total:
            entry = _entry("moved", tenant, rotations.current_epoch(), by)
            self._context.audit_log.record(entry)
        if broken:
            raise StoreError(
                f"{len(broken)} templates of tenant {tenant!r} could not be moved to its new "
                "rotation: their rows were altered, or a master key is missing. Put the key back "
                "and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def remaining(self, tenant: str) -> int:
        """Number of the tenant's templates that are not in its current epoch."""
        owner = self._tenants.get(tenant)
        return self._context.database.read(lambda connection: _count(connection, _is_old(owner.id)))

    def subjects_of_old_epochs(self, tenant: str, *, batch: int = 1000) -> Iterator[str]:
        """Ids, in order, of the subjects whose templates are not in the current epoch."""
        owner, after = self._tenants.get(tenant), ""
        database = self._context.database
        while names := database.read(partial(_old_subjects, owner.id, after, batch)):
            yield from names
            after = names[-1]

    def retire(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Drop the keys of all epochs but the current one; returns how many.

        Raises
        ------
        UnknownTenant
        StoreError
            If templates of older epochs are left.
        StoreUnavailable
            If a write that was under way at the start does not end within the timeout.
        """
        # The epoch is read before the wait. Writes that begin later know it, or a newer one, and
        # store no template in an earlier one.
        owner, database = self._tenants.get(tenant), self._context.database
        database.await_writers()

        def work(connection: Connection) -> int:
            older = sa.and_(
                SubjectRow.tenant_id == owner.id, TemplateRow.rotation_epoch < owner.rotation_epoch
            )
            if left := _count(connection, older):
                raise StoreError(
                    f"{left} templates of tenant {tenant!r} are still in an older rotation: "
                    "move them first, and enroll again the subjects of another contract"
                )
            dropped = connection.execute(
                sa.delete(RotationKeyRow).where(
                    RotationKeyRow.tenant_id == owner.id,
                    RotationKeyRow.epoch < owner.rotation_epoch,
                )
            ).rowcount
            if dropped:
                entry = _entry("retired", tenant, owner.rotation_epoch, by)
                self._context.audit_log.append(connection, entry)
            return dropped

        dropped = self._context.write(work)
        database.purge_log()
        return dropped

    def _rotate_all(
        self, rotations: "_Rotations", rows: Sequence[Any], broken: set[str]
    ) -> list[_Rotated]:
        epoch, rotated = rotations.current_epoch(), []
        for row in rows:
            try:
                stored = open_envelope(envelope_of(row), owner_of(row), self._context.keyring)
                rotated.append(rotations.rotated(row, stored, epoch))
            except (SealError, TemplateError, RetiredRotation):
                broken.add(row.subject_pk)
        return rotated

    def _replace_all(self, connection: Connection, *, rotated: Sequence[_Rotated]) -> int:
        return sum(self._replace(connection, template) for template in rotated)

    def _replace(self, connection: Connection, rotated: _Rotated) -> bool:
        """Put the rotated template in the place of the one read, if that is still there."""
        row = rotated.row
        # A row that another write holds is looked at again, rather than waited for: an erasure
        # takes the two rows in the other order.
        unchanged = connection.execute(
            sa.select(SubjectRow.id)
            .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
            .where(
                SubjectRow.id == row.subject_pk,
                SubjectRow.wrapped_key == row.wrapped_key,
                TemplateRow.ciphertext == row.ciphertext,
            )
            .with_for_update(skip_locked=True)
        ).one_or_none()
        if unchanged is None:
            return False
        new = close_envelope(rotated.wire, rotated.owner, self._context.keyring)
        connection.execute(
            sa.update(SubjectRow)
            .where(SubjectRow.id == row.subject_pk)
            .values(wrapped_key=new.wrapped_key, wrapping_key=sealed_key_id(new.wrapped_key))
        )
        connection.execute(
            sa.update(TemplateRow)
            .where(TemplateRow.subject_pk == row.subject_pk)
            .values(
                contract_id=rotated.owner.contract_id,
                rotation_epoch=rotated.owner.rotation_epoch,
                ciphertext=new.ciphertext,
            )
        )
        return True


def _entry(outcome: str, tenant: str, epoch: int, by: By) -> Entry:
    return Entry(ACTION, outcome, by, tenant=tenant, detail=f"epoch {epoch}")


class _Rotations:
    """Brings templates of one tenant from one epoch, and rotation version, into another."""

    def __init__(self, tenants: Tenants, tenant: str, binding: Binding) -> None:
        self._tenants = tenants
        self._tenant = tenant
        self._binding = binding
        self._of_epochs: dict[int, TenantRotation] = {}

    def current_epoch(self) -> int:
        return self._tenants.get(self._tenant).rotation_epoch

    def rotated(self, row: Any, stored: bytes, epoch: int) -> _Rotated:
        """Turn the wire bytes of a row's template as the contract's templates of an epoch are."""
        binding, template = self._binding, wire.decode(stored)
        shape = template.subspace.n, template.subspace.m
        if template.contract_id != row.contract_id or shape != (binding.axes, binding.m):
            raise InvalidTemplate("a stored template is not of the contract that its row names")
        old = self._of(row.rotation_epoch).of(row.template_id)
        new = self._of(epoch).of(row.template_id)
        turned = template.subspace.turned_by(lambda points: new.turned(old.turned_back(points)))
        owner = replace(owner_of(row), contract_id=binding.contract_id, rotation_epoch=epoch)
        data = wire.encode(turned, contract_id=binding.contract_id, dtype=template.dtype)
        return _Rotated(row, owner, data)

    def _of(self, epoch: int) -> TenantRotation:
        if epoch not in self._of_epochs:
            key = self._tenants.rotation_key(self._tenant, epoch=epoch).key
            self._of_epochs[epoch] = TenantRotation(key, self._binding.axes)
        return self._of_epochs[epoch]


def _current_epoch(tenant_id: str) -> sa.ScalarSelect[int]:
    return sa.select(TenantRow.rotation_epoch).where(TenantRow.id == tenant_id).scalar_subquery()


def _is_old(tenant_id: str) -> sa.ColumnElement[bool]:
    return sa.and_(
        SubjectRow.tenant_id == tenant_id, TemplateRow.rotation_epoch != _current_epoch(tenant_id)
    )


def _count(connection: Connection, condition: sa.ColumnElement[bool]) -> int:
    query = (
        sa.select(sa.func.count())
        .select_from(SubjectRow)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .where(condition)
    )
    return int(connection.execute(query).scalar_one())


def _old_subjects(tenant_id: str, after: str, batch: int, connection: Connection) -> Sequence[str]:
    query = (
        sa.select(SubjectRow.subject_id)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .where(_is_old(tenant_id), SubjectRow.subject_id > after)
        .order_by(SubjectRow.subject_id)
        .limit(batch)
    )
    return connection.execute(query).scalars().all()


def _old_templates(
    tenant_id: str, contract_id: str, after: str, batch: int, connection: Connection
) -> Sequence[Any]:
    query = (
        sa.select(*TEMPLATE_COLUMNS)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .where(
            _is_old(tenant_id),
            TemplateRow.contract_id == contract_id,
            SubjectRow.id > after,
        )
        .order_by(SubjectRow.id)
        .limit(batch)
    )
    return connection.execute(query).all()
