"""Rows that decide something, authenticated: who can write the database but has no key makes none.

Each carries an HMAC-SHA256 over its deciding columns, under a key that only the master key opens
(:meth:`AuditLog.row_key`). A MAC alone does not tell an old state of a row from the present one.
So where the audit log tells of each change, the row also carries the number of the last line about
it, and is good only while the log holds no later one. The log is never shortened: putting back an
old row needs the lines after it removed, which ``veilface audit-log verify`` finds.

A row that does not pass is as good as none.
"""

import hashlib
import hmac
import json
import logging
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa

from templates.store.schema import (
    KEY_LINES,
    TENANT_LINES,
    ApiKeyRow,
    AuditRow,
    Base,
    FailedAttemptsRow,
    TenantRow,
)

AUTHENTICATED: dict[type[Base], tuple[str, ...]] = {
    TenantRow: ("id", "name", "rotation_epoch", "created_at", "template_enrollment", "line"),
    ApiKeyRow: (
        "id",
        "tenant_id",
        "tenant",
        "prefix",
        "token_hash",
        "rights",
        "label",
        "created_at",
        "expires_at",
        "revoked_at",
        "lowest_level",
        "line",
    ),
    FailedAttemptsRow: (
        "tenant_id",
        "pseudonym",
        "consecutive",
        "total",
        "last_failed_at",
        "locked_until",
        "disabled_at",
        "line",
    ),
}
"""The columns that a MAC covers, in its order.
`tenant` of a key is the name of its tenant: so the tenant's own row decides nothing about a request
but what is asked of :class:`Tenants`."""


def last_line(*which: Any) -> Any:
    """Select the number of the last line that meets conditions, or no row.

    Not as a maximum: for that, PostgreSQL may read all lines that meet them.
    """
    query = sa.select(AuditRow.sequence).where(*which)
    # Written out: with a parameter, PostgreSQL would plan for many lines, and plan every time.
    return query.order_by(AuditRow.sequence.desc()).limit(sa.literal_column("1"))


LAST_KEY_LINE = (
    last_line(AuditRow.detail == ApiKeyRow.prefix, KEY_LINES).correlate(ApiKeyRow).scalar_subquery()
)
"""Number of the last line about a key; NULL where there is none."""
TENANT_OF_KEY = (
    sa.select(TenantRow.name)
    .where(TenantRow.id == ApiKeyRow.tenant_id)
    .correlate(ApiKeyRow)
    .scalar_subquery()
)
"""Name of a key's tenant."""
LAST_TENANT_LINE = (
    last_line(AuditRow.tenant == TenantRow.name, TENANT_LINES)
    .correlate(TenantRow)
    .scalar_subquery()
)
"""Number of the last line about a tenant itself; NULL where there is none."""

_logger = logging.getLogger("veilface.store")


def row_mac(key: bytes, table: type[Base], values: Mapping[str, Any]) -> bytes:
    """MAC of a row.

    Parameters
    ----------
    key
        :meth:`AuditLog.row_key`.
    table, values
        Which table; the row's columns by name, those of :data:`AUTHENTICATED` at least.

    Raises
    ------
    TypeError
        For a value of a type that no such column holds.
    """
    parts = ["row", table.__tablename__, *(values[name] for name in AUTHENTICATED[table])]
    return hmac.digest(key, _encoded(parts).encode(), hashlib.sha256)


def is_authentic(key: bytes, table: type[Base], values: Mapping[str, Any]) -> bool:
    """Whether a row, its ``mac`` among the values, is one that a holder of the key wrote."""
    mac = values["mac"]
    try:
        expected = row_mac(key, table, values)
    except TypeError:
        return False
    return isinstance(mac, bytes) and hmac.compare_digest(expected, mac)


def is_current(key: bytes, table: type[Base], values: Mapping[str, Any]) -> bool:
    """:func:`is_authentic`, and no line after the row's own tells of a change.

    `values` has ``last_line`` too: :data:`LAST_KEY_LINE` or :data:`LAST_TENANT_LINE`.
    """
    return is_authentic(key, table, values) and values["line"] >= (values["last_line"] or 0)


def columns_of(table: type[Base]) -> list[Any]:
    """The authenticated columns that a table has itself, and ``mac``."""
    names = (name for name in (*AUTHENTICATED[table], "mac") if name != "tenant")
    return [getattr(table, name) for name in names]


def warn(event: str, **fields: str) -> None:
    """Tell the operator of a row that was passed over.

    Parameters
    ----------
    event
        A fixed text.
    fields
        Of those that a line of the service's log may have.
    """
    _logger.warning(event, extra={"fields": fields})


def _plain(value: object) -> dict[str, str]:
    # An object, which no column holds: so neither can be taken for a text.
    match value:
        case datetime():
            return {"time": value.astimezone(UTC).isoformat(timespec="microseconds")}
        case bytes():
            return {"bytes": value.hex()}
        case _:
            raise TypeError(f"no column that is authenticated holds a {type(value).__name__}")


_encoded = json.JSONEncoder(separators=(",", ":"), default=_plain).encode
