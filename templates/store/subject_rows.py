"""Reading a subject's rows: its record, and its template opened."""

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.keys.sealing import MasterKeyring
from templates.store.envelope import Envelope, Owner, open_envelope
from templates.store.schema import SubjectRow, TemplateRow, TenantRow


class Source(StrEnum):
    """What a template was made from."""

    PHOTOS = "photos"
    TEMPLATE = "template"


@dataclass(frozen=True)
class SubjectRecord:
    """What is known of a subject without opening its template.

    `holder_salt` is None where the template needs no holder's key.
    """

    subject_id: str
    template_id: str
    contract_id: str
    rotation_epoch: int
    n: int
    m: int
    dtype: str
    source: Source
    photos: int
    holder_salt: str | None
    created_at: datetime
    updated_at: datetime


@dataclass(frozen=True)
class SubjectTemplate:
    """A subject with its decrypted template; the wire bytes stay out of its repr."""

    record: SubjectRecord
    wire: bytes = field(repr=False)

    @property
    def template_id(self) -> str:
        """Id of the template, which its rotation is derived from."""
        return self.record.template_id

    @property
    def holder_salt(self) -> str | None:
        """What its holder's rotation is derived from, with their key; None if it needs no key."""
        return self.record.holder_salt


RECORD_COLUMNS = tuple(
    getattr(SubjectRow if name in ("subject_id", "created_at", "updated_at") else TemplateRow, name)
    for name in SubjectRecord.__dataclass_fields__
)
"""What :func:`read_record` needs."""
TEMPLATE_COLUMNS = (
    *RECORD_COLUMNS,
    SubjectRow.id.label("subject_pk"),
    SubjectRow.tenant_id,
    SubjectRow.wrapped_key,
    TemplateRow.ciphertext,
)
"""What the functions below need."""


def select_subjects(columns: tuple[Any, ...], tenant: str) -> Any:
    """Select columns of the subjects of a tenant, each with its template."""
    return (
        sa.select(*columns)
        .select_from(SubjectRow)
        .join(TemplateRow, TemplateRow.subject_pk == SubjectRow.id)
        .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
        .where(TenantRow.name == tenant)
    )


def read_record(row: Any) -> SubjectRecord:
    """Read a row that has :data:`RECORD_COLUMNS`."""
    values = {name: row._mapping[name] for name in SubjectRecord.__dataclass_fields__}
    return SubjectRecord(**{**values, "source": Source(row.source)})


def owner_of(row: Any) -> Owner:
    """What the template of a row belongs to."""
    return Owner(**{name: row._mapping[name] for name in Owner.__dataclass_fields__})


def opened_template(row: Any, keyring: MasterKeyring) -> SubjectTemplate:
    """Decrypt the template of a row; :class:`SealError` as of :func:`open_envelope`."""
    wire = open_envelope(Envelope(row.wrapped_key, row.ciphertext), owner_of(row), keyring)
    return SubjectTemplate(record=read_record(row), wire=wire)


def subject_pk_of(connection: Connection, tenant_id: str, subject_id: str) -> str | None:
    """Row id of a subject, or None."""
    return connection.execute(
        sa.select(SubjectRow.id).where(
            SubjectRow.tenant_id == tenant_id, SubjectRow.subject_id == subject_id
        )
    ).scalar_one_or_none()
