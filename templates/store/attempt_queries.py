"""What a verification asks of the database: one query before its decision, one in its record.

The statements are made once: building one costs more than running it. After a renewal of secrets,
older lines of the audit log name a subject by earlier pseudonyms, so what asks the log is made for
a number of them.
"""

import functools
from collections.abc import Sequence
from typing import Any, cast

import sqlalchemy as sa
from sqlalchemy.orm import aliased

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
_OTHER = aliased(TemplateRow)

COUNTS = tuple(
    getattr(FailedAttemptsRow, name).label(f"counted_{name}")
    for name in (*AUTHENTICATED[FailedAttemptsRow], "mac")
)
"""What is counted of a subject; NULL where nothing is."""

_ATTEMPTS = (
    # A line beyond the head is none: nobody is kept from inserting one.
    AuditRow.sequence <= sa.select(AuditHeadRow.sequence).scalar_subquery(),
    ATTEMPT_LINES,
)

LINES_OF_ATTEMPTS: Any = (
    sa.select(*(getattr(AuditRow, name) for name in Line.__dataclass_fields__))
    .where(AuditRow.pseudonym.in_(sa.bindparam("pseudonyms", expanding=True)), *_ATTEMPTS)
    .order_by(AuditRow.sequence.desc())
    .limit(sa.bindparam("most"))
)
"""Of `pseudonyms`: the latest `most` of these lines, the last one first."""


def named(pseudonyms: Sequence[str]) -> dict[str, str]:
    """Parameters that :func:`before` and :func:`standing` take a subject's pseudonyms by."""
    return dict(zip(_names(len(pseudonyms)), pseudonyms, strict=True))


def _names(count: int) -> list[str]:
    return ["pseudonym", *(f"pseudonym_{number}" for number in range(1, count))]


def _last_attempt(count: int) -> sa.Subquery:
    """Last line of the audit log that tells of an attempt on the subject, or of their end."""
    # One for each pseudonym, each read from the end of its index; together, all would be sorted.
    last: list[Any] = [
        last_line(AuditRow.pseudonym == sa.bindparam(name), *_ATTEMPTS).add_columns(
            AuditRow.outcome
        )
        for name in _names(count)
    ]
    if count > 1:
        either = sa.union_all(*(sa.select(line.subquery()) for line in last)).subquery()
        last = [sa.select(either).order_by(either.c.sequence.desc()).limit(1)]
    subquery: sa.Subquery = last[0].subquery("last_attempt")
    return subquery


def _last_line(last: sa.Subquery) -> tuple[Any, Any]:
    return last.c.sequence.label("last_sequence"), last.c.outcome.label("last_outcome")


def _first_stored(least: Any) -> Any:
    """First ciphertext by the ids of rows from `least` on; NULL if there is none."""
    return (
        sa.select(_OTHER.ciphertext)
        .where(_OTHER.subject_pk >= least)
        .order_by(_OTHER.subject_pk)
        .limit(1)
        .scalar_subquery()
    )


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


@functools.cache
def before(count: int) -> Any:
    """All that is looked at before a decision; one row where there is the tenant.

    Of `tenant`, :func:`named` for so many pseudonyms, `subject_id`, `contract_id`, `key_prefix`,
    `nonce_hash`, `nonce_digest` and `place`. The columns of the template are NULL where the subject
    has none of the contract.

    Where no ciphertext of the subject is stored, `stand_in` is that of whoever comes next after
    `place`, by the ids of their rows: a template's bytes take a time that would tell who is
    enrolled, and one row for all who are not would always be warm. It is opened by nobody.
    """
    last = _last_attempt(count)
    stand_in = sa.func.coalesce(_first_stored(sa.bindparam("place")), _first_stored(sa.literal("")))
    return (
        sa.select(
            *TEMPLATE_COLUMNS,
            sa.case((TemplateRow.ciphertext.is_(None), stand_in)).label("stand_in"),
            TenantRow.rotation_epoch.label("current_epoch"),
            sa.or_(sa.exists(_USED_NONCE), sa.exists(_LOGGED_NONCE)).label("used"),
            *COUNTS,
            *_last_line(last),
        )
        .select_from(TenantRow)
        .outerjoin(FailedAttemptsRow, _FAILURES)
        .outerjoin(last, sa.true())
        .outerjoin(SubjectRow, _SUBJECT)
        .outerjoin(
            TemplateRow,
            sa.and_(
                _TEMPLATE,
                TemplateRow.contract_id == sa.bindparam("contract_id"),
            ),
        )
        .where(_TENANT)
    )


@functools.cache
def standing(count: int) -> Any:
    """What a decision is recorded against; one row where there is the tenant.

    Of `tenant`, :func:`named` for so many pseudonyms, `subject_id`, `key_prefix` and
    `nonce_digest`.
    """
    last = _last_attempt(count)
    return (
        sa.select(
            TenantRow.id.label("tenant_id"),
            *COUNTS,
            *_last_line(last),
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
        .outerjoin(last, sa.true())
        .outerjoin(SubjectRow, _SUBJECT)
        .outerjoin(TemplateRow, _TEMPLATE)
        .where(_TENANT)
    )


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
