"""What a verification asks of the database: one query before its decision, one in its record.

The statements are made once: building one costs more than running it.
"""

from typing import Any, cast

import sqlalchemy as sa

from templates.store.schema import (
    ApiKeyRow,
    FailedAttemptsRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
    UsedNonceRow,
)
from templates.store.subjects import TEMPLATE_COLUMNS

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

COUNTS = (
    FailedAttemptsRow.consecutive,
    FailedAttemptsRow.total,
    FailedAttemptsRow.last_failed_at,
    FailedAttemptsRow.locked_until,
    FailedAttemptsRow.disabled_at,
)

FAILURES = sa.select(*COUNTS).join(TenantRow, _FAILURES).where(_TENANT)
"""Of `tenant` and `pseudonym`."""

_USED_NONCE = (
    sa.select(UsedNonceRow.nonce_hash)
    .join(ApiKeyRow, ApiKeyRow.id == UsedNonceRow.api_key_id)
    .where(
        ApiKeyRow.prefix == sa.bindparam("key_prefix"),
        UsedNonceRow.nonce_hash == sa.bindparam("nonce_hash"),
    )
)

BEFORE: Any = (
    sa.select(
        TenantRow.rotation_epoch.label("current_epoch"),
        sa.exists(_USED_NONCE).label("used"),
        FailedAttemptsRow.locked_until,
        FailedAttemptsRow.disabled_at,
        TemplateRow.template_id,
        *TEMPLATE_COLUMNS,
    )
    .select_from(TenantRow)
    .outerjoin(FailedAttemptsRow, _FAILURES)
    .outerjoin(SubjectRow, _SUBJECT)
    .outerjoin(
        TemplateRow,
        sa.and_(_TEMPLATE, TemplateRow.contract_id == sa.bindparam("contract_id")),
    )
    .where(_TENANT)
)
"""All that is looked at before a decision; one row where there is the tenant.

Of `tenant`, `pseudonym`, `subject_id`, `contract_id`, `key_prefix` and `nonce_hash`. The columns
from the sixth on are those of a template, and NULL where the subject has none of the contract.
"""

STANDING: Any = (
    sa.select(
        TenantRow.id.label("tenant_id"),
        *COUNTS,
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
    .outerjoin(SubjectRow, _SUBJECT)
    .outerjoin(TemplateRow, _TEMPLATE)
    .where(_TENANT)
)
"""What a decision is recorded against; one row where there is the tenant.

Of `tenant`, `pseudonym`, `subject_id` and `key_prefix`. `consecutive` is NULL where nothing is
counted.
"""

_failures = cast(sa.Table, FailedAttemptsRow.__table__)
_subjects = cast(sa.Table, SubjectRow.__table__)
_of_subject = (
    _failures.c.tenant_id == sa.bindparam("of_tenant"),
    _failures.c.pseudonym == sa.bindparam("of_pseudonym"),
)

FIRST_FAILURE = sa.insert(_failures)
NEXT_FAILURE = sa.update(_failures).where(*_of_subject)
"""Of `of_tenant` and `of_pseudonym`; sets the other parameters."""
FORGET_FAILURES = (
    sa.update(_failures)
    .where(
        *_of_subject,
        sa.or_(
            _failures.c.consecutive > 0,
            _failures.c.locked_until.is_not(None),
            _failures.c.disabled_at.is_not(None),
        ),
    )
    .values(consecutive=0, locked_until=None, disabled_at=None)
)
"""Of `of_tenant` and `of_pseudonym`; no row changes where there is nothing to forget."""
NOTE_USE = sa.update(_subjects).where(_subjects.c.id == sa.bindparam("of_subject"))
"""Sets `last_used_at`."""
