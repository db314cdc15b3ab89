"""What the database holds of one subject, as it lies there: to show people what is stored."""

from dataclasses import dataclass, field
from datetime import datetime

from templates.keys.sealing import MasterKeyring
from templates.store.database import Database
from templates.store.identifiers import checked_subject_id
from templates.store.schema import SubjectRow
from templates.store.subjects import SubjectTemplate, opened_template, template_query


@dataclass(frozen=True)
class StoredForm:
    """A subject's template as it is stored.

    Attributes
    ----------
    template
        What the ciphertext opens to, and its metadata.
    sealed
        The ciphertext, byte for byte: version, nonce, AES-256-GCM, tag.
    last_used_at
        Time of the last accepted verification.
    """

    template: SubjectTemplate
    sealed: bytes = field(repr=False)
    last_used_at: datetime | None


def stored_form(
    database: Database, keyring: MasterKeyring, tenant: str, subject_id: str
) -> StoredForm | None:
    """Read one subject's template as it is stored, in one query; None if there is none.

    Raises
    ------
    SealError
        If the row was altered or moved, or its master key is missing.
    """
    query = template_query(tenant, checked_subject_id(subject_id))
    query = query.add_columns(SubjectRow.last_used_at)
    row = database.read(lambda each: each.execute(query).one_or_none())
    if row is None:
        return None
    *columns, last_used_at = row
    return StoredForm(opened_template(columns, keyring), bytes(row.ciphertext), last_used_at)
