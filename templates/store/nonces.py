"""Nonces: what was used once and must not be used again.

A nonce that is used up has a row for some minutes, which two transactions cannot both insert, and
a keyed digest in the line of the audit log that tells what it was used for: removing the row
changes nothing, and the line tells later what came of it.
"""

import hashlib
import hmac
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.audit_chain import Line, is_true_line
from templates.store.authenticity import warn
from templates.store.context import StoreContext
from templates.store.deployment import insert_once
from templates.store.lockout import Nonce, Replayed
from templates.store.schema import ApiKeyRow, AuditHeadRow, AuditRow, UsedNonceRow

_KEY_ID: Any = sa.select(ApiKeyRow.id).where(ApiKeyRow.prefix == sa.bindparam("prefix"))
_LINE: Any = (
    sa.select(*(getattr(AuditRow, name) for name in Line.__dataclass_fields__))
    .where(
        AuditRow.nonce == sa.bindparam("digest"),
        # A line beyond the head is none: nobody is kept from inserting one.
        AuditRow.sequence <= sa.select(AuditHeadRow.sequence).scalar_subquery(),
    )
    .order_by(AuditRow.sequence)
    .limit(1)
)


class Nonces:
    """Repository of used nonces."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def digest(self, nonce: Nonce) -> str:
        """What the audit log keeps of a nonce, 64 hexadecimal digits."""
        message = encode_parts("nonce", nonce.key_prefix, nonce.hash)
        row_key = self._context.audit_log.row_key()
        return hmac.new(row_key, message, hashlib.sha256).hexdigest()

    def line(self, nonce: Nonce) -> Line | None:
        """Return the line of the audit log that tells what a nonce was used for, if it was used.

        One that is not as it was written is none, and leaves a warning.
        """

        def work(connection: Connection) -> Line | None:
            row = self._row(connection, nonce)
            line = None if row is None else Line(**row._mapping)
            if line is None or is_true_line(self._context.audit_log.line_keys(), line):
                return line
            warn("a line of the audit log is not authentic and was passed over")
            return None

        try:
            return self._context.read(work)
        except (ValueError, TypeError):
            # SQLite keeps any value in any column.
            raise StoreError(
                "a line of the audit log was altered: run `veilface audit-log verify`"
            ) from None

    def require_unused(self, nonce: Nonce) -> None:
        """Refuse early what :meth:`use` would refuse; it decides nothing itself.

        Raises
        ------
        Replayed
        """
        if self._context.read(lambda connection: self._row(connection, nonce)) is not None:
            raise Replayed

    def use(self, connection: Connection, nonce: Nonce) -> str:
        """Use a nonce up in a transaction; return its digest, for the line of the audit log.

        Raises
        ------
        Replayed
            If it was used before.
        StoreError
            If its API key is gone.
        """
        key_id = connection.execute(_KEY_ID, {"prefix": nonce.key_prefix}).scalar_one_or_none()
        logged = self._row(connection, nonce) is not None
        spend(connection, nonce, key_id=key_id, used=logged)
        return self.digest(nonce)

    def _row(self, connection: Connection, nonce: Nonce) -> Any:
        return connection.execute(_LINE, {"digest": self.digest(nonce)}).one_or_none()


def spend(connection: Connection, nonce: Nonce, *, key_id: str | None, used: bool) -> None:
    """Insert the row of a nonce.

    Parameters
    ----------
    key_id
        Row id of its API key; None where there is none.
    used
        Whether the audit log has a line of it.

    Raises
    ------
    Replayed
        If it was used before.
    StoreError
        If there is no such API key.
    """
    if key_id is None:
        raise StoreError("there is no API key of this prefix")
    if used or not insert_once(
        connection,
        UsedNonceRow,
        api_key_id=key_id,
        nonce_hash=nonce.hash,
        expires_at=nonce.expires_at,
    ):
        raise Replayed
