"""What a verification asks of the database: one query before its decision, one in its record.

The statements are made once: building one costs more than running it.
"""

from typing import Any, cast

import sqlalchemy as sa

from templates.store.audit_chain import Line
from templates.store.authenticity import AUTHENTICATED, last_line
from templates.store.schema import (
    ATTEMPT_LINES,
    TENANT_LINES,
    ApiKeyRow,
    AuditHeadRow,
    AuditRow,
    FailedAttemptsRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
    UsedNonceRow,
)
from templates.store.subject_rows import TEMPLATE_COLUMNS

_TENANT = TenantRow.name == sa.bindparam("tenant")
_FAILURES = sa.and_(
    FailedAttemptsRow.tenant_id == TenantRow.id,
    FailedAttemptsRow.pseudonym == sa.bindparam("pseudonym"),
)
_SUBJECT = sa.and_(
    SubjectRow.tenant_id == TenantRow.id,
    SubjectRow.subject_id == sa.bindparam("subject_id"),
)
_TEMPLATE = TemplateRow.subject_pk == SubjectRow.id

COUNTS = tuple(
    getattr(FailedAttemptsRow, name).label(f"counted_{name}")
    for name in (*AUTHENTICATED[FailedAttemptsRow], "mac")
)
"""What is counted of a subject; NULL where nothing is."""

# A line beyond the head is none: nobody is kept from inserting one.
_OF_SUBJECT = (
    AuditRow.pseudonym == sa.bindparam("pseudonym"),
    AuditRow.sequence <= sa.select(AuditHeadRow.sequence).scalar_subquery(),
    ATTEMPT_LINES,
)
_LAST = last_line(*_OF_SUBJECT).add_columns(AuditRow.outcome).subquery("last_attempt")
LAST_LINE = (_LAST.c.sequence.label("last_sequence"), _LAST.c.outcome.label("last_outcome"))
"""Last line of the audit log that tells of an attempt on the subject, or of their end."""

LINES_OF_ATTEMPTS: Any = (
    sa.select(*(getattr(AuditRow, name) for name in Line.__dataclass_fields__))
    .where(*_OF_SUBJECT)
    .order_by(AuditRow.sequence.desc())
    .limit(sa.bindparam("most"))
)
"""Of `pseudonym`: the latest `most` of these lines, the last one first."""

TENANT_ERASED: Any = last_line(
    AuditRow.tenant == sa.bindparam("tenant"), AuditRow.outcome == "erased", TENANT_LINES
)
"""Number of the line of `tenant`'s last erasure; no row where there was none."""

_USED_NONCE = (
    sa.select(UsedNonceRow.nonce_hash)
    .join(ApiKeyRow, ApiKeyRow.id == UsedNonceRow.api_key_id)
    .where(
        ApiKeyRow.prefix == sa.bindparam("key_prefix"),
        UsedNonceRow.nonce_hash == sa.bindparam("nonce_hash"),
    )
)

_LOGGED_NONCE = sa.select(AuditRow.sequence).where(AuditRow.nonce == sa.bindparam("nonce_digest"))

BEFORE: Any = (
    sa.select(
        *TEMPLATE_COLUMNS,
        TenantRow.rotation_epoch.label("current_epoch"),
        sa.or_(sa.exists(_USED_NONCE), sa.exists(_LOGGED_NONCE)).label("used"),
        *COUNTS,
        *LAST_LINE,
    )
    .select_from(TenantRow)
    .outerjoin(FailedAttemptsRow, _FAILURES)
    .outerjoin(_LAST, sa.true())
    .outerjoin(SubjectRow, _SUBJECT)
    .outerjoin(
        TemplateRow,
        sa.and_(_TEMPLATE, TemplateRow.contract_id == sa.bindparam("contract_id")),
    )
    .where(_TENANT)
)
"""All that is looked at before a decision; one row where there is the tenant.

Of `tenant`, `pseudonym`, `subject_id`, `contract_id`, `key_prefix`, `nonce_hash` and
`nonce_digest`. The columns of the template are NULL where the subject has none of the contract.
"""

STANDING: Any = (
    sa.select(
        TenantRow.id.label("tenant_id"),
        *COUNTS,
        *LAST_LINE,
        sa.exists(_LOGGED_NONCE).label("used"),
        SubjectRow.id.label("subject_pk"),
        TemplateRow.template_id,
        TemplateRow.contract_id,
        sa.select(ApiKeyRow.id)
        .where(ApiKeyRow.prefix == sa.bindparam("key_prefix"))
        .scalar_subquery()
        .label("api_key_id"),
    )
    .select_from(TenantRow)
    .outerjoin(FailedAttemptsRow, _FAILURES)
    .outerjoin(_LAST, sa.true())
    .outerjoin(SubjectRow, _SUBJECT)
    .outerjoin(TemplateRow, _TEMPLATE)
    .where(_TENANT)
)
"""What a decision is recorded against; one row where there is the tenant.

Of `tenant`, `pseudonym`, `subject_id`, `key_prefix` and `nonce_digest`.
"""

_failures = cast(sa.Table, FailedAttemptsRow.__table__)
_subjects = cast(sa.Table, SubjectRow.__table__)

FIRST_COUNTS = sa.insert(_failures)
NEXT_COUNTS = sa.update(_failures).where(
    _failures.c.tenant_id == sa.bindparam("of_tenant"),
    _failures.c.pseudonym == sa.bindparam("of_pseudonym"),
)
"""Of `of_tenant` and `of_pseudonym`; sets the other parameters."""
NOTE_USE = sa.update(_subjects).where(_subjects.c.id == sa.bindparam("of_subject"))
"""Sets `last_used_at`."""
