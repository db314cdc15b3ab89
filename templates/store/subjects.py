"""Subjects and their templates: put, get, describe, list."""

import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreBusy, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store.audit_log import PROGRAM, By, Entry, is_used, template_digest
from templates.store.context import StoreContext
from templates.store.cursors import close_cursor, open_cursor
from templates.store.envelope import open_template, seal_template
from templates.store.identifiers import (
    InvalidIdentifier,
    checked_subject_id,
    checked_subject_prefix,
)
from templates.store.lockout import Replayed
from templates.store.schema import IDS, SEALED, Source, SubjectRow, TenantRow
from templates.store.tenants import tenant_of

MAX_PAGE = 1000

_CURSOR_PURPOSE = "list-cursor"


class EnrollmentConflict(StoreError):
    """The subject has another template than a write may replace, `template_id`, or has none."""

    template_id: str | None = None

    def __init__(self, template_id: str | None) -> None:
        super().__init__(
            "the subject has another template than the request may replace, or has none: name the "
            "one that it has, name none to enroll it, or choose another subject id"
        )
        self.template_id = template_id


@dataclass(frozen=True)
class Precondition:
    """What a subject must have before a write: this template, or, where it is None, none."""

    template_id: str | None


@dataclass(frozen=True)
class SubjectTemplate:
    """A subject with its decrypted template; the wire bytes stay out of its repr."""

    record: SubjectRow
    wire: bytes = field(repr=False)

    @property
    def template_id(self) -> str:
        """Id of the template, which its rotation is derived from."""
        return self.record.template_id

    @property
    def holder_salt(self) -> str | None:
        """What its holder's rotation is derived from, with their key; None if it needs no key."""
        return self.record.holder_salt


@dataclass(frozen=True)
class SubjectPage:
    """One page of subjects; `next_cursor` is None on the last one."""

    records: Sequence[SubjectRow]
    next_cursor: str | None


class Subjects:
    """Repository of subjects."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def put(
        self,
        tenant: str,
        subject_id: str,
        wire: bytes,
        *,
        contract_id: str,
        source: Source,
        photos: int,
        template_id: str,
        holder_salt: str | None = None,
        rotation_epoch: int | None = None,
        precondition: Precondition | None = None,
        action: Literal["enroll", "import"] = "enroll",
        token: str | None = None,
        by: By = PROGRAM,
    ) -> bool:
        """Store a template in one transaction; returns whether it replaced another one.

        Parameters
        ----------
        contract_id, source, photos
            Metadata that stays readable without a key.
        template_id
            Random, and another one for each enrollment: the template's rotation is derived from it.
        holder_salt
            What the holder's rotation is derived from; None where the template needs no key.
        rotation_epoch
            Epoch of the tenant's key that the template is turned by; the current one by default.
            Another one is refused: its key is, or will be, dropped.
        precondition
            What may be replaced; whatever there is by default.
        token
            Digest of the one-use token that allows the enrollment, which uses it up.

        Raises
        ------
        InvalidIdentifier, UnknownTenant, StoreError, StoreUnavailable, EnrollmentConflict, Replayed

        Notes
        -----
        A replacement gets a fresh data key, and the old key and ciphertext go: the old key, out of
        a backup, does not help to read the new template.
        """
        subject_id = checked_subject_id(subject_id)
        context = self._context
        pseudonym = context.signer.pseudonym(tenant, subject_id)
        with context.database.write() as session:
            owner, now = tenant_of(session, tenant), context.clock()
            if rotation_epoch not in (None, owner.rotation_epoch):
                raise StoreBusy("the tenant's rotation was renewed meanwhile; send it again")
            subject = subject_of(session, tenant, subject_id, IDS)
            enrolled = None if subject is None else subject.template_id
            if precondition is not None and enrolled != precondition.template_id:
                raise EnrollmentConflict(enrolled)
            if token is not None and is_used(session, token):
                raise Replayed
            replaces = subject is not None
            if subject is None:
                subject = SubjectRow(id=uuid.uuid4().hex, tenant_id=owner.id, created_at=now)
                subject.subject_id = subject_id
                session.add(subject)
            subject.template_id = template_id
            subject.contract_id = contract_id
            subject.rotation_epoch = owner.rotation_epoch
            subject.source, subject.photos = source, photos
            subject.holder_salt = holder_salt
            subject.updated_at = now
            # Sealed here: a rotation of the master key that ends later finds it.
            seal_template(subject, wire, context.keyring)
            outcome = "replaced" if replaces else "created"
            detail = template_digest(template_id)
            entry = Entry(action, outcome, by, tenant, pseudonym, detail, token)
            context.audit_log.append(session, entry)
        if replaces:
            context.database.purge_log()
        return replaces

    def record_export(self, tenant: str, subject_id: str, *, template_id: str, by: By) -> None:
        """Write the line of an export; :class:`StoreBusy` if it is no longer the subject's."""
        context = self._context
        pseudonym = context.signer.pseudonym(tenant, subject_id)
        with context.database.write() as session:
            subject = subject_of(session, tenant, checked_subject_id(subject_id))
            if subject is None or subject.template_id != template_id:
                raise StoreBusy("the subject was enrolled again or erased meanwhile: send it again")
            context.audit_log.append(session, Entry("export", "exported", by, tenant, pseudonym))

    def get(self, tenant: str, subject_id: str) -> SubjectTemplate | None:
        """Return a subject with its decrypted template, or None."""
        subject_id = checked_subject_id(subject_id)
        with self._context.database.read() as session:
            subject = subject_of(session, tenant, subject_id, SEALED)
        return None if subject is None else opened_template(subject, self._context.keyring)

    def describe(self, tenant: str, subject_id: str) -> SubjectRow | None:
        """Return a subject's metadata, or None; nothing is decrypted."""
        subject_id = checked_subject_id(subject_id)
        with self._context.database.read() as session:
            return subject_of(session, tenant, subject_id)

    def list(
        self, tenant: str, *, limit: int = 100, cursor: str | None = None, prefix: str = ""
    ) -> SubjectPage:
        """Return a page of a tenant's subjects, in the order of their ids.

        A subject that stays enrolled while the pages are read appears exactly once, whatever is
        enrolled or erased meanwhile.

        Parameters
        ----------
        limit
            1 to 1000.
        cursor
            `next_cursor` of the page before; it is sealed, so it shows no subject id.
        prefix
            Only subjects whose ids begin so.
        """
        if not 1 <= limit <= MAX_PAGE:
            raise InvalidIdentifier(f"the limit of a page is 1 to {MAX_PAGE}")
        query = _of_tenant(tenant).order_by(SubjectRow.subject_id).limit(limit + 1)
        keyring = self._context.keyring
        if cursor is not None:
            after = open_cursor(keyring, cursor, purpose=_CURSOR_PURPOSE, tenant=tenant)
            query = query.where(SubjectRow.subject_id > after)
        if prefix:
            # A range, which the index of the ids serves: no id has the last of all characters.
            first = checked_subject_prefix(prefix)
            query = query.where(SubjectRow.subject_id.between(first, f"{first}\U0010ffff"))
        with self._context.database.read() as session:
            rows = session.scalars(query).all()
        records = rows[:limit]
        if len(rows) <= limit:
            return SubjectPage(records, None)
        last = records[-1].subject_id
        return SubjectPage(
            records, close_cursor(keyring, last, purpose=_CURSOR_PURPOSE, tenant=tenant)
        )


def subject_of(session: Session, tenant: str, subject_id: str, *options: Any) -> SubjectRow | None:
    """A subject of a tenant, by its id in NFC, or None."""
    query = _of_tenant(tenant).where(SubjectRow.subject_id == subject_id).options(*options)
    return session.scalars(query).one_or_none()


def opened_template(subject: SubjectRow, keyring: MasterKeyring) -> SubjectTemplate:
    """Decrypt a subject's template; :class:`SealError` as of :func:`open_template`."""
    return SubjectTemplate(subject, open_template(subject, keyring))


def _of_tenant(tenant: str) -> sa.Select[SubjectRow]:
    return (
        sa.select(SubjectRow)
        .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
        .where(TenantRow.name == tenant)
    )
