"""When a subject was exported, and whether what was exported has been superseded since.

An export carries its :class:`Stamp` under its seal. Where it comes back to the deployment that made
it, the audit log tells exactly what happened after it, whatever the clocks of hosts say: the stamp
names the line of the export by its number and hash. In another deployment the times are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreBusy, StoreError
from templates.store.attempt_queries import TENANT_ERASED
from templates.store.audit_chain import Anchor
from templates.store.audit_log import By, Entry
from templates.store.authenticity import last_line
from templates.store.context import StoreContext
from templates.store.identifiers import checked_subject_id
from templates.store.schema import ENROLLMENT_LINES, AuditRow, SubjectRow, TemplateRow, TenantRow
from templates.store.subject_rows import subject_lock
from templates.store.subjects import Guard


class ExportSuperseded(StoreError):
    """The subject was erased or enrolled again after the export was made, or its key was retired.

    Importing it would undo that, or trust whoever has the key.
    """


_SUPERSEDED = (
    "the subject was erased or enrolled after this export was made, and importing it would "
    "undo that: export the subject again where it is enrolled, or enroll it; an operator "
    "may restore an old export knowingly"
)


@dataclass(frozen=True)
class Stamp:
    """When an export was made.

    Attributes
    ----------
    at
        By the clock of the host that made it.
    line
        Number and hash of the line of the audit log that tells of it.
    """

    at: datetime
    line: Anchor


class Transfers:
    """Stamps exports, and holds imports against what happened since."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def stamp(self, tenant: str, subject_id: str, *, template_id: str, by: By) -> Stamp:
        """Record that a template is exported, while it is still the subject's.

        Raises
        ------
        StoreBusy
            If the subject was enrolled again, or erased, since the template was read.
        """
        context = self._context
        checked_subject_id(subject_id)

        def work(connection: Connection) -> Stamp:
            subject = {"tenant": tenant, "subject_id": subject_id}
            if connection.execute(_TEMPLATE_ID, subject).scalar_one_or_none() != template_id:
                raise StoreBusy("the subject was enrolled again or erased meanwhile: send it again")
            pseudonym = context.signer.pseudonym(tenant, subject_id)
            entry = Entry("export", "exported", by, tenant, pseudonym)
            line = context.audit_log.append(connection, entry)
            own_hash = connection.execute(_HASH, {"line": line}).scalar_one()
            return Stamp(context.clock(), Anchor(line, own_hash))

        return context.write(work, lock=subject_lock(tenant, subject_id))

    def guard(self, tenant: str, stamp: Stamp | None, *, restore: bool, by: By) -> Guard:
        """What :meth:`Subjects.put` asks before it stores an import.

        Parameters
        ----------
        tenant, stamp
            Whose import it is, and the stamp of the export.
        restore
            Let it in though it is superseded; the audit log gets a line that says so.
        by
            Who imports, for that line.
        """

        def check(connection: Connection, pseudonyms: Sequence[str]) -> Entry | None:
            if not is_superseded(connection, tenant, pseudonyms, stamp):
                return None
            if not restore:
                raise ExportSuperseded(_SUPERSEDED)
            return Entry("import", "restored", by, tenant, pseudonyms[0])

        return check


def is_superseded(
    connection: Connection, tenant: str, pseudonyms: Sequence[str], stamp: Stamp | None
) -> bool:
    """Whether the subject was enrolled or erased here after an export of it was made.

    Parameters
    ----------
    connection
        Of the transaction that would import it, under the lock of the subject.
    tenant, pseudonyms
        Whom it would be imported for.
    stamp
        Of the export; None for one from before exports had any, which anything supersedes.
    """
    about_subject = (
        connection.execute(_LAST_LINE, {"pseudonym": pseudonym}).scalar() or 0
        for pseudonym in pseudonyms
    )
    last = max(connection.execute(TENANT_ERASED, {"tenant": tenant}).scalar() or 0, *about_subject)
    if not last or stamp is None:
        return bool(last)
    own_hash = connection.execute(_HASH, {"line": stamp.line.sequence}).scalar_one_or_none()
    if own_hash == stamp.line.hash:
        return last > stamp.line.sequence
    at = connection.execute(_TIME, {"line": last}).scalar_one()
    return bool(at >= stamp.at)


_TEMPLATE_ID: Any = (
    sa.select(TemplateRow.template_id)
    .join(SubjectRow, SubjectRow.id == TemplateRow.subject_pk)
    .join(TenantRow, TenantRow.id == SubjectRow.tenant_id)
    .where(
        TenantRow.name == sa.bindparam("tenant"),
        SubjectRow.subject_id == sa.bindparam("subject_id"),
    )
)
# A reset of a lock that was not there also leaves a line with the outcome `nothing_held`.
_LAST_LINE = last_line(
    AuditRow.pseudonym == sa.bindparam("pseudonym"),
    ENROLLMENT_LINES,
    AuditRow.action != sa.literal_column("'lockout-reset'"),
)
_HASH: Any = sa.select(AuditRow.hash).where(AuditRow.sequence == sa.bindparam("line"))
_TIME: Any = sa.select(AuditRow.at).where(AuditRow.sequence == sa.bindparam("line"))
