"""Subjects and their templates: put, get, describe, list."""

import base64
import binascii
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import SealError, StoreBusy, StoreError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.audit_log import PROGRAM, AuditLog, By, Entry
from templates.store.database import Database
from templates.store.envelope import Envelope, Owner, close_envelope, open_envelope
from templates.store.identifiers import (
    Clock,
    InvalidIdentifier,
    UnknownTenant,
    checked_opaque_id,
    checked_subject_id,
)
from templates.store.receipts import ReceiptSigner
from templates.store.schema import FailedAttemptsRow, SubjectRow, TemplateRow, TenantRow

MAX_WIRE_BYTES = 4 * 1024 * 1024  # a float32 template of n = 4096, m = 128 has 2.1 MB
MAX_PAGE = 1000

_CURSOR_PURPOSE = "list-cursor"

Guard = Callable[[Connection, str], Entry | None]


class Source(StrEnum):
    """What a template was made from."""

    PHOTOS = "photos"
    TEMPLATE = "template"


@dataclass(frozen=True)
class StoredTemplate:
    """What :meth:`Subjects.put` did."""

    template_id: str
    created: bool


@dataclass(frozen=True)
class SubjectRecord:
    """What is known of a subject without opening its template."""

    subject_id: str
    template_id: str
    contract_id: str
    rotation_epoch: int
    n: int
    m: int
    dtype: str
    source: Source
    photos: int
    created_at: datetime
    updated_at: datetime


@dataclass(frozen=True)
class SubjectTemplate:
    """A subject with its decrypted template; the wire bytes stay out of its repr."""

    record: SubjectRecord
    wire: bytes = field(repr=False)


@dataclass(frozen=True)
class SubjectPage:
    """One page of subjects; `next_cursor` is None on the last one."""

    records: tuple[SubjectRecord, ...]
    next_cursor: str | None


class Subjects:
    """Repository of subjects."""

    def __init__(
        self,
        database: Database,
        keyring: MasterKeyring,
        signer: ReceiptSigner,
        audit_log: AuditLog,
        clock: Clock,
    ) -> None:
        self._database = database
        self._keyring = keyring
        self._signer = signer
        self.audit_log = audit_log
        self._clock = clock

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
        template_id: str | None = None,
        rotation_epoch: int | None = None,
        guard: Guard | None = None,
        by: By = PROGRAM,
    ) -> StoredTemplate:
        """Store a template, or replace the one there is, in one transaction.

        Parameters
        ----------
        tenant, subject_id
            Whose it is.
        wire
            The template's wire bytes, 4 MiB at most.
        contract_id, n, m, dtype, source, photos
            Metadata that stays readable without a key.
        template_id
            Made here when not given.
        rotation_epoch
            Epoch of the tenant's rotation that the template is in; the current one by default.
            Another one is refused: its key is, or will be, dropped.
        guard
            Called in the transaction with its connection and the subject's pseudonym, before
            anything is written. What it raises takes the enrollment back; what it returns goes
            into the audit log before the enrollment's own line.
        by
            Who enrolls, for the audit log.

        Raises
        ------
        InvalidIdentifier, UnknownTenant, StoreError, StoreUnavailable

        Notes
        -----
        A replacement gets a fresh data key, and the old key and ciphertext are removed with it:
        an old backup of one of the two rows does not help to read the other.
        """
        checked_subject_id(subject_id)
        checked_opaque_id(contract_id, what="contract id")
        template_id = checked_opaque_id(template_id or uuid.uuid4().hex, what="template id")
        if not 0 < len(wire) <= MAX_WIRE_BYTES:
            raise StoreError(
                f"a template has 1 to {MAX_WIRE_BYTES} wire bytes, this has {len(wire)}"
            )
        pseudonym = self._signer.pseudonym(tenant, subject_id)
        self.audit_log.prepare()

        def work(connection: Connection) -> bool:
            tenant_id, current_epoch = tenant_row(connection, tenant)
            epoch = current_epoch if rotation_epoch is None else rotation_epoch
            if epoch != current_epoch:
                raise StoreBusy("the tenant's rotation was renewed meanwhile; send it again")
            noted = None if guard is None else guard(connection, pseudonym)
            now = self._clock()
            known = subject_row_id(connection, tenant_id, subject_id)
            subject_pk = known or uuid.uuid4().hex
            owner = Owner(tenant_id, subject_pk, subject_id, contract_id, template_id, epoch)
            envelope = close_envelope(wire, owner, self._keyring)
            key_columns = {
                "wrapped_key": envelope.wrapped_key,
                "wrapping_key": sealed_key_id(envelope.wrapped_key),
                "updated_at": now,
            }
            if known is None:
                connection.execute(
                    sa.insert(SubjectRow).values(
                        id=subject_pk,
                        tenant_id=tenant_id,
                        subject_id=subject_id,
                        created_at=now,
                        **key_columns,
                    )
                )
                # A count of failures from before goes when the subject goes, and not earlier.
                connection.execute(
                    sa.update(FailedAttemptsRow)
                    .where(
                        FailedAttemptsRow.tenant_id == tenant_id,
                        FailedAttemptsRow.pseudonym == pseudonym,
                    )
                    .values(known=True)
                )
            else:
                connection.execute(
                    sa.update(SubjectRow).where(SubjectRow.id == known).values(**key_columns)
                )
                connection.execute(sa.delete(TemplateRow).where(TemplateRow.subject_pk == known))
            connection.execute(
                sa.insert(TemplateRow).values(
                    subject_pk=subject_pk,
                    template_id=template_id,
                    contract_id=contract_id,
                    rotation_epoch=epoch,
                    ciphertext=envelope.ciphertext,
                    n=n,
                    m=m,
                    dtype=dtype,
                    source=Source(source).value,
                    photos=photos,
                    created_at=now,
                )
            )
            if noted is not None:
                self.audit_log.append(connection, noted)
            outcome = "created" if known is None else "replaced"
            self.audit_log.append(connection, Entry("enroll", outcome, by, tenant, pseudonym))
            return known is None

        created = self._database.write(work, lock=subject_lock(tenant, subject_id))
        if not created:
            self._database.try_purge_log()
        return StoredTemplate(template_id=template_id, created=created)

    def get(
        self, tenant: str, subject_id: str, *, contract_id: str | None = None
    ) -> SubjectTemplate | None:
        """Return a subject with its decrypted template, or None.

        Parameters
        ----------
        tenant, subject_id
            Whose it is.
        contract_id
            If given, a template of another contract is as good as none: nothing of it is read or
            decrypted, so that it costs what a subject costs that does not exist.

        Raises
        ------
        SealError
            If the row was altered or moved, or its master key is missing.
        """
        query = template_query(tenant, checked_subject_id(subject_id))
        if contract_id is not None:
            query = query.where(TemplateRow.contract_id == contract_id)
        row = self._database.read(lambda each: each.execute(query).one_or_none())
        return None if row is None else opened_template(row, self._keyring)

    def describe(self, tenant: str, subject_id: str) -> SubjectRecord | None:
        """Return a subject's metadata, or None; nothing is decrypted."""
        checked_subject_id(subject_id)
        query = _records(tenant).where(SubjectRow.subject_id == subject_id)
        row = self._database.read(lambda each: each.execute(query).one_or_none())
        return None if row is None else _record(row)

    def list(self, tenant: str, *, limit: int = 100, cursor: str | None = None) -> SubjectPage:
        """Return a page of a tenant's subjects, in the order of their ids.

        A subject that stays enrolled while the pages are read appears exactly once, whatever is
        enrolled or erased meanwhile.

        Parameters
        ----------
        tenant
            Whose subjects.
        limit
            1 to 1000.
        cursor
            `next_cursor` of the page before; it is sealed, so it shows no subject id.

        Raises
        ------
        InvalidIdentifier
            For a limit out of range, or a cursor that this store did not give for this tenant.
        """
        if not 1 <= limit <= MAX_PAGE:
            raise InvalidIdentifier(f"the limit of a page is 1 to {MAX_PAGE}")
        query = _records(tenant).order_by(SubjectRow.subject_id).limit(limit + 1)
        if cursor is not None:
            query = query.where(SubjectRow.subject_id > self._after(tenant, cursor))
        rows = self._database.read(lambda each: each.execute(query).all())
        records = tuple(_record(row) for row in rows[:limit])
        return SubjectPage(
            records=records,
            next_cursor=self._cursor(tenant, records[-1]) if len(rows) > limit else None,
        )

    def _cursor(self, tenant: str, last: SubjectRecord) -> str:
        sealed = self._keyring.seal(
            last.subject_id.encode(), purpose=_CURSOR_PURPOSE, bound_to=[tenant]
        )
        return base64.urlsafe_b64encode(sealed).decode().rstrip("=")

    def _after(self, tenant: str, cursor: str) -> str:
        if len(cursor) > 512:
            raise InvalidIdentifier("this cursor is too long to be one of ours")
        try:
            sealed = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
            opened = self._keyring.open(
                sealed, purpose=_CURSOR_PURPOSE, bound_to=[tenant], refresh=False
            )
        except (SealError, binascii.Error, ValueError):
            raise InvalidIdentifier(
                "this cursor was not given for this list: start again without one"
            ) from None
        return opened.decode()


_RECORD_COLUMNS = (
    SubjectRow.subject_id,
    TemplateRow.template_id,
    TemplateRow.contract_id,
    TemplateRow.rotation_epoch,
    TemplateRow.n,
    TemplateRow.m,
    TemplateRow.dtype,
    TemplateRow.source,
    TemplateRow.photos,
    SubjectRow.created_at,
    SubjectRow.updated_at,
)

TEMPLATE_COLUMNS = (
    *_RECORD_COLUMNS,
    SubjectRow.id,
    SubjectRow.tenant_id,
    SubjectRow.wrapped_key,
    TemplateRow.ciphertext,
)
"""What :func:`opened_template` needs."""


def _records(
    tenant: str,
) -> "sa.Select[*tuple[Any, ...]]":  # quoted: variadic from SQLAlchemy 2.1 on
    return (
        sa.select(*_RECORD_COLUMNS)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
        .where(TenantRow.name == tenant)
    )


def _record(columns: Any) -> SubjectRecord:
    values = dict(zip(SubjectRecord.__dataclass_fields__, columns, strict=True))
    return SubjectRecord(**{**values, "source": Source(values["source"])})


def template_query(tenant: str, subject_id: str) -> Any:
    """Select a subject's template, as :data:`TEMPLATE_COLUMNS`."""
    return (
        sa.select(*TEMPLATE_COLUMNS)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
        .where(TenantRow.name == tenant, SubjectRow.subject_id == subject_id)
    )


def opened_template(columns: Any, keyring: MasterKeyring) -> SubjectTemplate:
    """Decrypt a template that was read as :data:`TEMPLATE_COLUMNS`.

    Raises
    ------
    SealError
        If the row was altered or moved, or its master key is missing.
    """
    *metadata, subject_pk, tenant_id, wrapped_key, ciphertext = columns
    record = _record(metadata)
    owner = Owner(
        tenant_id,
        subject_pk,
        record.subject_id,
        record.contract_id,
        record.template_id,
        record.rotation_epoch,
    )
    wire = open_envelope(Envelope(wrapped_key, ciphertext), owner, keyring)
    return SubjectTemplate(record=record, wire=wire)


def tenant_row(connection: Connection, name: str) -> tuple[str, int]:
    """Row id and rotation epoch of a tenant, or :class:`UnknownTenant`."""
    row = connection.execute(
        sa.select(TenantRow.id, TenantRow.rotation_epoch).where(TenantRow.name == name)
    ).one_or_none()
    if row is None:
        raise UnknownTenant(f"there is no tenant {name!r}")
    return row.id, row.rotation_epoch


def subject_row_id(connection: Connection, tenant_id: str, subject_id: str) -> str | None:
    """Row id of a subject, or None."""
    return connection.execute(
        sa.select(SubjectRow.id).where(
            SubjectRow.tenant_id == tenant_id, SubjectRow.subject_id == subject_id
        )
    ).scalar_one_or_none()


def subject_lock(tenant: str, subject_id: str) -> str:
    """Name of the lock under which a subject is written."""
    return f"subject {tenant} {subject_id}"
