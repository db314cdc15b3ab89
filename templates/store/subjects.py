"""Subjects and their templates: put, get, describe, list."""

import uuid
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreBusy, StoreError
from templates.keys.sealing import sealed_key_id
from templates.store.audit_log import PROGRAM, By, Entry, is_used, template_digest
from templates.store.context import StoreContext
from templates.store.cursors import close_cursor, open_cursor
from templates.store.envelope import Envelope, Owner, close_envelope
from templates.store.identifiers import (
    InvalidIdentifier,
    checked_opaque_id,
    checked_subject_id,
    checked_subject_prefix,
)
from templates.store.lockout import Replayed
from templates.store.schema import SubjectRow, TemplateRow
from templates.store.subject_rows import (
    RECORD_COLUMNS,
    TEMPLATE_COLUMNS,
    Source,
    SubjectRecord,
    SubjectTemplate,
    opened_template,
    read_record,
    select_subjects,
    subject_pk_of,
)
from templates.store.tenants import tenant_of

MAX_WIRE_BYTES = 4 * 1024 * 1024  # a float32 template of n = 4096, m = 192 has 3.2 MB
MAX_PAGE = 1000

_CURSOR_PURPOSE = "list-cursor"


class EnrollmentConflict(StoreError):
    """The subject has another template than a write may replace; it is left as it was.

    Attributes
    ----------
    template_id
        The template that the subject has; None if it is not enrolled.
    """

    template_id: str | None = None

    def __init__(self, template_id: str | None) -> None:
        super().__init__(
            "the subject is not enrolled, and there is nothing to replace: enroll it without "
            "naming a template"
            if template_id is None
            else "the subject is enrolled, with another template than the request may replace: "
            "name that one, or choose another subject id"
        )
        self.template_id = template_id


@dataclass(frozen=True)
class Precondition:
    """What a subject must have before a write: this template, or, where it is None, none."""

    template_id: str | None


@dataclass(frozen=True)
class StoredTemplate:
    """What :meth:`Subjects.put` did."""

    template_id: str
    created: bool


@dataclass(frozen=True)
class SubjectPage:
    """One page of subjects; `next_cursor` is None on the last one."""

    records: tuple[SubjectRecord, ...]
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
        n: int,
        m: int,
        dtype: str,
        source: Source,
        photos: int,
        template_id: str,
        holder_salt: str | None = None,
        rotation_epoch: int | None = None,
        precondition: Precondition | None = None,
        action: Literal["enroll", "import"] = "enroll",
        token: str | None = None,
        by: By = PROGRAM,
    ) -> StoredTemplate:
        """Store a template, or replace the one there is, in one transaction.

        Parameters
        ----------
        wire
            The template's wire bytes, 4 MiB at most.
        contract_id, n, m, dtype, source, photos
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
        A replacement gets a fresh data key, and the old key and ciphertext are removed with it:
        an old backup of one of the two rows does not help to read the other.
        """
        subject_id = checked_subject_id(subject_id)
        checked_opaque_id(contract_id, what="contract id")
        template_id = checked_opaque_id(template_id, what="template id")
        if not 0 < len(wire) <= MAX_WIRE_BYTES:
            raise StoreError(
                f"a template has 1 to {MAX_WIRE_BYTES} wire bytes, this has {len(wire)}"
            )
        context = self._context
        pseudonym = context.signer.pseudonym(tenant, subject_id)

        def work(connection: Connection) -> StoredTemplate:
            owner_tenant = tenant_of(connection, tenant)
            epoch = owner_tenant.rotation_epoch
            if rotation_epoch not in (None, epoch):
                raise StoreBusy("the tenant's rotation was renewed meanwhile; send it again")
            enrolled_pk = subject_pk_of(connection, owner_tenant.id, subject_id)
            if precondition is not None:
                enrolled = connection.execute(_TEMPLATE_ID, {"pk": enrolled_pk}).scalar()
                if enrolled != precondition.template_id:
                    raise EnrollmentConflict(enrolled)
            if token is not None and is_used(connection, token):
                raise Replayed
            is_new, subject_pk = enrolled_pk is None, enrolled_pk or uuid.uuid4().hex
            owner = Owner(
                owner_tenant.id,
                subject_pk,
                subject_id,
                contract_id,
                template_id,
                epoch,
                holder_salt,
            )
            # Sealed here: a rotation of the master key that ends later finds it.
            envelope = close_envelope(wire, owner, context.keyring)
            metadata = {"n": n, "m": m, "dtype": dtype, "source": Source(source), "photos": photos}
            now = context.clock()
            _write_rows(connection, owner, envelope, metadata, is_new=is_new, now=now)
            outcome = "created" if is_new else "replaced"
            detail = template_digest(template_id)
            entry = Entry(action, outcome, by, tenant, pseudonym, detail, token)
            context.audit_log.append(connection, entry)
            return StoredTemplate(template_id, is_new)

        stored = context.database.write(work)
        if not stored.created:
            context.database.purge_log()
        return stored

    def record_export(self, tenant: str, subject_id: str, *, template_id: str, by: By) -> None:
        """Write the line of an export; :class:`StoreBusy` if it is no longer the subject's."""
        context = self._context
        query = select_subjects((TemplateRow.template_id,), tenant).where(
            SubjectRow.subject_id == checked_subject_id(subject_id)
        )
        pseudonym = context.signer.pseudonym(tenant, subject_id)

        def work(connection: Connection) -> None:
            if connection.execute(query).scalar_one_or_none() != template_id:
                raise StoreBusy("the subject was enrolled again or erased meanwhile: send it again")
            context.audit_log.append(connection, Entry("export", "exported", by, tenant, pseudonym))

        context.database.write(work)

    def get(self, tenant: str, subject_id: str) -> SubjectTemplate | None:
        """Return a subject with its decrypted template, or None."""
        row = self._row(TEMPLATE_COLUMNS, tenant, subject_id)
        return None if row is None else opened_template(row, self._context.keyring)

    def describe(self, tenant: str, subject_id: str) -> SubjectRecord | None:
        """Return a subject's metadata, or None; nothing is decrypted."""
        row = self._row(RECORD_COLUMNS, tenant, subject_id)
        return None if row is None else read_record(row)

    def _row(self, columns: tuple[Any, ...], tenant: str, subject_id: str) -> Any:
        subject = SubjectRow.subject_id == checked_subject_id(subject_id)
        query = select_subjects(columns, tenant).where(subject)
        return self._context.database.read(
            lambda connection: connection.execute(query).one_or_none()
        )

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
        query = (
            select_subjects(RECORD_COLUMNS, tenant).order_by(SubjectRow.subject_id).limit(limit + 1)
        )
        keyring = self._context.keyring
        if cursor is not None:
            after = open_cursor(keyring, cursor, purpose=_CURSOR_PURPOSE, tenant=tenant)
            query = query.where(SubjectRow.subject_id > after)
        if prefix:
            # A range, which the index of the ids serves: no id has the last of all characters.
            first = checked_subject_prefix(prefix)
            query = query.where(SubjectRow.subject_id.between(first, f"{first}\U0010ffff"))
        rows = self._context.database.read(lambda connection: connection.execute(query).all())
        records = tuple(read_record(row) for row in rows[:limit])
        if len(rows) <= limit:
            return SubjectPage(records, None)
        last = records[-1].subject_id
        return SubjectPage(
            records, close_cursor(keyring, last, purpose=_CURSOR_PURPOSE, tenant=tenant)
        )


_TEMPLATE_ID = sa.select(TemplateRow.template_id).where(
    TemplateRow.subject_pk == sa.bindparam("pk")
)


def _write_rows(
    connection: Connection,
    owner: Owner,
    envelope: Envelope,
    metadata: dict[str, Any],
    *,
    is_new: bool,
    now: datetime,
) -> None:
    """Insert a subject and its template, or replace the template and the data key there are."""
    key_columns = {
        "wrapped_key": envelope.wrapped_key,
        "wrapping_key": sealed_key_id(envelope.wrapped_key),
        "updated_at": now,
    }
    if is_new:
        identity = {
            "id": owner.subject_pk,
            "tenant_id": owner.tenant_id,
            "subject_id": owner.subject_id,
        }
        connection.execute(sa.insert(SubjectRow).values(**identity, created_at=now, **key_columns))
    else:
        connection.execute(
            sa.update(SubjectRow).where(SubjectRow.id == owner.subject_pk).values(**key_columns)
        )
        connection.execute(sa.delete(TemplateRow).where(TemplateRow.subject_pk == owner.subject_pk))
    connection.execute(
        sa.insert(TemplateRow).values(
            subject_pk=owner.subject_pk,
            template_id=owner.template_id,
            contract_id=owner.contract_id,
            rotation_epoch=owner.rotation_epoch,
            holder_salt=owner.holder_salt,
            ciphertext=envelope.ciphertext,
            created_at=now,
            **metadata,
        )
    )
