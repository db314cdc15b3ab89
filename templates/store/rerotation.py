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

import functools
from collections.abc import Callable, Sequence

import sqlalchemy as sa
from sqlalchemy.orm import Session, load_only

from templates.contract import wire
from templates.contract.binding import Binding
from templates.errors import InvalidTemplate, SealError, StoreError, TemplateError
from templates.keys.rotation import TenantRotation
from templates.store.audit_log import PROGRAM, By, Entry
from templates.store.context import StoreContext
from templates.store.database import delete
from templates.store.envelope import open_template, seal_template
from templates.store.schema import RotationKeyRow, SubjectRow, TenantRow
from templates.store.tenants import RetiredRotation, Tenants, tenant_of

ACTION = "tenant-rotate"
# A row of which another column cannot be read is moved all the same.
OPENED = load_only(
    SubjectRow.tenant_id,
    SubjectRow.subject_id,
    SubjectRow.contract_id,
    SubjectRow.template_id,
    SubjectRow.rotation_epoch,
    SubjectRow.holder_salt,
    SubjectRow.wrapped_key,
    SubjectRow.ciphertext,
)
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
        with self._context.database.write() as session:
            owner = tenant_of(session, tenant)
            owner.rotation_epoch += 1
            self._tenants.add_rotation_key(session, owner)
            self._note(session, "begun", owner, by)
            return owner.rotation_epoch

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
        total, broken, after = 0, 0, ""

        @functools.cache
        def rotation(epoch: int) -> TenantRotation:
            return TenantRotation(self._tenants.rotation_key(tenant, epoch), binding.axes)

        while True:
            moved, failed, after = self._move_batch(tenant, binding, rotation, after, batch)
            if not moved + failed:
                break
            total, broken = total + moved, broken + failed
            if progress is not None and moved:
                progress(moved)
        self._context.database.purge_log()
        if total:
            with self._context.database.write() as session:
                self._note(session, "moved", tenant_of(session, tenant), by)
        if broken:
            raise StoreError(
                f"{broken} templates of tenant {tenant!r} could not be moved to its new "
                "rotation: their rows were altered, or a master key is missing. Put the key back "
                "and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def subjects_of_old_epochs(self, tenant: str) -> Sequence[str]:
        """Ids, in order, of the subjects whose templates are not in the current epoch."""
        with self._context.database.read() as session:
            return _subjects_of_old_epochs(session, tenant_of(session, tenant))

    def retire(self, tenant: str, *, by: By = PROGRAM) -> int:
        """Drop the keys of all epochs but the current one; returns how many.

        :class:`StoreError` if templates of older epochs are left.
        """
        with self._context.database.write() as session:
            owner = tenant_of(session, tenant)
            if left := _subjects_of_old_epochs(session, owner):
                raise StoreError(
                    f"{len(left)} templates of tenant {tenant!r} are still in an older rotation: "
                    "move them first, and enroll again the subjects that cannot be moved"
                )
            dropped = delete(
                session,
                RotationKeyRow,
                RotationKeyRow.tenant_id == owner.id,
                RotationKeyRow.epoch < owner.rotation_epoch,
            )
            if dropped:
                self._note(session, "retired", owner, by)
        self._context.database.purge_log()
        return dropped

    def _note(self, session: Session, outcome: str, tenant: TenantRow, by: By) -> None:
        detail = f"epoch {tenant.rotation_epoch}"
        self._context.audit_log.append(
            session, Entry(ACTION, outcome, by, tenant.name, detail=detail)
        )

    def _move_batch(
        self,
        tenant: str,
        binding: Binding,
        rotation: Callable[[int], TenantRotation],
        after: str,
        batch: int,
    ) -> tuple[int, int, str]:
        """Turn the templates after a row; returns how many, how many failed, and the last row."""
        moved = broken = 0
        keyring = self._context.keyring
        with self._context.database.write() as session:
            owner = tenant_of(session, tenant)
            query = (
                sa.select(SubjectRow)
                .options(OPENED)
                .where(_is_older(owner), SubjectRow.contract_id == binding.contract_id)
                .where(SubjectRow.id > after)
                .order_by(SubjectRow.id)
                .limit(batch)
            )
            for subject in session.scalars(query).all():
                after = subject.id
                try:
                    old, new = rotation(subject.rotation_epoch), rotation(owner.rotation_epoch)
                    turned = _turned(open_template(subject, keyring), subject, binding, old, new)
                except (SealError, TemplateError, RetiredRotation):
                    broken += 1
                    continue
                subject.rotation_epoch = owner.rotation_epoch
                seal_template(subject, turned, keyring)
                moved += 1
        return moved, broken, after


def _turned(
    stored: bytes, subject: SubjectRow, binding: Binding, old: TenantRotation, new: TenantRotation
) -> bytes:
    """The wire bytes of a stored template in another rotation."""
    template = wire.decode(stored)
    shape = template.subspace.n, template.subspace.m
    if template.contract_id != subject.contract_id or shape != (binding.axes, binding.m):
        raise InvalidTemplate("a stored template is not of the contract that its row names")
    back, forth = old.of(subject.template_id), new.of(subject.template_id)
    turned = template.subspace.turned_by(lambda points: forth.turned(back.turned_back(points)))
    return wire.encode(turned, contract_id=binding.contract_id, dtype=template.dtype)


def _is_older(owner: TenantRow) -> sa.ColumnElement[bool]:
    return sa.and_(
        SubjectRow.tenant_id == owner.id, SubjectRow.rotation_epoch < owner.rotation_epoch
    )


def _subjects_of_old_epochs(session: Session, owner: TenantRow) -> Sequence[str]:
    query = sa.select(SubjectRow.subject_id).where(_is_older(owner)).order_by(SubjectRow.subject_id)
    return session.scalars(query).all()
