"""Renewing a tenant's rotation: a new epoch, templates moved into it, and the old keys dropped.

::

    begin    a new key; templates are enrolled in the new epoch from now on, both are verified
    move     stored templates of older epochs into the current one, beside a service in use
    retire   the keys of the older epochs go, when nothing needs them

A template of the old rotation R is turned by R' Rᵀ, which is R' x for every x that was R x, so
nobody has to enroll again. It protects what is stored from now on. A copy of the database that was
taken before, with its rotation key and master key, keeps what it had.

Each move rounds to the stored precision once more. In half precision at n = 512 and m = 16 the
distance of a probe to the template then differs from the one before by 1.3·10⁻⁵ in the root mean
square, and by 8·10⁻⁵ at most over 400,000 pairs: as much as the first rounding costs
(``tests/templates/store/test_rerotation.py``). They add up like independent errors: after three
moves the distance is 2.6·10⁻⁵ from that to the template before any rounding.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import sqlalchemy as sa
from numpy.typing import NDArray
from sqlalchemy.engine import Connection

from templates.contract import wire
from templates.errors import SealError, StoreError, TemplateError
from templates.keys.rotation import tenant_rotation
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.audit_log import PROGRAM, AuditLog, By, Entry
from templates.store.database import Database
from templates.store.envelope import Envelope, Owner, close_envelope, open_envelope
from templates.store.schema import RotationKeyRow, SubjectRow, TemplateRow, TenantRow
from templates.store.tenants import RetiredRotation, Tenants

ACTION = "tenant-rotate"
BATCH = 50
PURGE_WAIT_S = 0.25
_PAUSE_S = 0.05

Rotation = NDArray[np.float64]


@dataclass(frozen=True)
class _Stored:
    """A template as it was read."""

    owner: Owner
    envelope: Envelope = field(repr=False)


@dataclass(frozen=True)
class _Turned:
    """A template in the new epoch, and the row that it replaces."""

    stored: _Stored
    epoch: int
    wire: bytes = field(repr=False)


class Rerotation:
    """Renews the rotations of tenants."""

    def __init__(
        self,
        database: Database,
        keyring: MasterKeyring,
        tenants: Tenants,
        audit_log: AuditLog,
    ) -> None:
        self._database = database
        self._keyring = keyring
        self._tenants = tenants
        self._audit_log = audit_log

    def begin(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Make a new rotation, in which templates are enrolled from now on; returns its epoch.

        Stored templates stay in theirs until :meth:`move` has seen them.

        Raises
        ------
        UnknownTenant
        """
        self._audit_log.prepare()

        def work(connection: Connection) -> int:
            owner = self._tenants.locked(connection, tenant)
            epoch = owner.rotation_epoch + 1
            self._tenants.add_rotation_key(connection, owner.id, epoch)
            entry = _entry("begun", tenant, epoch, by)
            self._tenants.change(connection, owner, entry, rotation_epoch=epoch)
            return epoch

        return self._database.write(work)

    def move(
        self,
        tenant: str,
        *,
        batch: int = BATCH,
        progress: Callable[[int], None] | None = None,
        by: By = PROGRAM,
    ) -> int:
        """Bring stored templates of older epochs into the current one; returns how many.

        Template id, contract, metadata and times stay; the data key is a new one. A subject that
        is enrolled or erased meanwhile is left as it is. It may be interrupted, run again, and run
        by several processes at once.

        Parameters
        ----------
        tenant
            Whose templates.
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
        owner = self._tenants.get(tenant)
        # An enrollment that read the epoch before the renewal may commit into the old one still.
        self._database.await_writers()
        turns = _Turns(self._tenants, tenant)
        total, broken = 0, set[str]()
        while True:
            moved, left, after = 0, 0, ""
            broken_before, broken = broken, set()
            while rows := self._database.read(
                partial(_old_templates, tenant_id=owner.id, after=after, batch=batch)
            ):
                after = rows[-1].owner.subject_pk
                turned = self._turn_all(turns, rows, broken)
                changed = self._database.write(partial(self._replace_all, turned=turned))
                moved, left = moved + changed, left + len(turned) - changed
                if progress is not None and changed:
                    progress(changed)
            total += moved
            # What did not open may have been half seen: only what fails twice is broken.
            if not left and broken <= broken_before:
                break
            if not moved:
                time.sleep(_PAUSE_S)  # another write holds them
        self._database.try_purge_log(wait=PURGE_WAIT_S)
        if total:
            self._audit_log.record(_entry("moved", tenant, turns.current_epoch(), by))
        if broken:
            raise StoreError(
                f"{len(broken)} templates of tenant {tenant!r} could not be moved to its new "
                "rotation: their rows were altered, or a master key is missing. Put the key back "
                "and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def remaining(self, tenant: str) -> int:
        """Number of the tenant's templates that are not in its current rotation."""
        owner = self._tenants.get(tenant)
        return self._database.read(lambda each: _count(each, _is_old(owner.id)))

    def subjects_of_old_epochs(self, tenant: str, *, batch: int = 1000) -> Iterator[str]:
        """Ids, in order, of the subjects whose templates are not in the current rotation."""
        owner, after = self._tenants.get(tenant), ""
        while names := self._database.read(partial(_old_subjects, owner.id, after, batch)):
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
        owner = self._tenants.get(tenant)
        self._audit_log.prepare()
        self._database.await_writers()

        def work(connection: Connection) -> int:
            older = sa.and_(
                SubjectRow.tenant_id == owner.id, TemplateRow.rotation_epoch < owner.rotation_epoch
            )
            if left := _count(connection, older):
                raise StoreError(
                    f"{left} templates of tenant {tenant!r} are still in an older rotation: "
                    "move them first"
                )
            dropped = connection.execute(
                sa.delete(RotationKeyRow).where(
                    RotationKeyRow.tenant_id == owner.id,
                    RotationKeyRow.epoch < owner.rotation_epoch,
                )
            ).rowcount
            if dropped:
                self._note(connection, "retired", tenant, owner.rotation_epoch, by)
            return dropped

        dropped = self._database.write(work)
        self._database.try_purge_log(wait=PURGE_WAIT_S)
        return dropped

    def _turn_all(
        self, turns: "_Turns", rows: Sequence[_Stored], broken: set[str]
    ) -> list[_Turned]:
        epoch, turned = turns.current_epoch(), []
        for stored in rows:
            try:
                opened = open_envelope(stored.envelope, stored.owner, self._keyring)
                turned.append(_Turned(stored, epoch, turns.turn(opened, stored.owner, epoch)))
            except (SealError, TemplateError, RetiredRotation):
                broken.add(stored.owner.subject_pk)
        return turned

    def _replace_all(self, connection: Connection, *, turned: Sequence[_Turned]) -> int:
        return sum(self._replace(connection, each) for each in turned)

    def _replace(self, connection: Connection, turned: _Turned) -> bool:
        """Put the turned template in the place of the one that was read, if that is still there."""
        old, envelope = turned.stored.owner, turned.stored.envelope
        # A row that another write holds is looked at again, rather than waited for: an erasure
        # takes the two rows in the other order.
        unchanged = connection.execute(
            sa.select(SubjectRow.id)
            .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
            .where(
                SubjectRow.id == old.subject_pk,
                SubjectRow.wrapped_key == envelope.wrapped_key,
                TemplateRow.ciphertext == envelope.ciphertext,
            )
            .with_for_update(skip_locked=True)
        ).one_or_none()
        if unchanged is None:
            return False
        owner = Owner(
            old.tenant_id,
            old.subject_pk,
            old.subject_id,
            old.contract_id,
            old.template_id,
            turned.epoch,
        )
        new = close_envelope(turned.wire, owner, self._keyring)
        connection.execute(
            sa.update(SubjectRow)
            .where(SubjectRow.id == old.subject_pk)
            .values(wrapped_key=new.wrapped_key, wrapping_key=sealed_key_id(new.wrapped_key))
        )
        connection.execute(
            sa.update(TemplateRow)
            .where(TemplateRow.subject_pk == old.subject_pk)
            .values(rotation_epoch=turned.epoch, ciphertext=new.ciphertext)
        )
        return True

    def _note(self, connection: Connection, outcome: str, tenant: str, epoch: int, by: By) -> None:
        self._audit_log.append(connection, _entry(outcome, tenant, epoch, by))


def _entry(outcome: str, tenant: str, epoch: int, by: By) -> Entry:
    return Entry(ACTION, outcome, by, tenant=tenant, detail=f"epoch {epoch}")


class _Turns:
    """The matrices that turn templates of one tenant from an epoch into the current one."""

    def __init__(self, tenants: Tenants, tenant: str) -> None:
        self._tenants = tenants
        self._tenant = tenant
        self._rotations: dict[tuple[int, int], Rotation] = {}
        self._turns: dict[tuple[int, int, int], Rotation] = {}

    def current_epoch(self) -> int:
        return self._tenants.get(self._tenant).rotation_epoch

    def turn(self, stored: bytes, owner: Owner, epoch: int) -> bytes:
        template = wire.decode(stored)
        turn = self._between(owner.rotation_epoch, epoch, template.subspace.n)
        return wire.encode(
            template.subspace.rotated(turn), contract_id=template.contract_id, dtype=template.dtype
        )

    def _between(self, old: int, new: int, n: int) -> Rotation:
        if (old, new, n) not in self._turns:
            self._turns[old, new, n] = self._rotation(new, n) @ self._rotation(old, n).T
        return self._turns[old, new, n]

    def _rotation(self, epoch: int, n: int) -> Rotation:
        if (epoch, n) not in self._rotations:
            key = self._tenants.rotation_key(self._tenant, epoch=epoch).key
            self._rotations[epoch, n] = tenant_rotation(key, n)
        return self._rotations[epoch, n]


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
    connection: Connection, *, tenant_id: str, after: str, batch: int
) -> list[_Stored]:
    query = (
        sa.select(
            SubjectRow.tenant_id,
            SubjectRow.id,
            SubjectRow.subject_id,
            TemplateRow.contract_id,
            TemplateRow.template_id,
            TemplateRow.rotation_epoch,
            SubjectRow.wrapped_key,
            TemplateRow.ciphertext,
        )
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .where(_is_old(tenant_id), SubjectRow.id > after)
        .order_by(SubjectRow.id)
        .limit(batch)
    )
    return [_stored(row) for row in connection.execute(query)]


def _stored(row: Any) -> _Stored:
    *owner, wrapped_key, ciphertext = row
    return _Stored(Owner(*owner), Envelope(wrapped_key, ciphertext))
