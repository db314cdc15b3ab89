"""The audit log: who did what to which subject, and with which result.

A line names the subject by its pseudonym, and holds nothing of a face. It is written in the
transaction of what it tells of: what is committed has its line, and what is rolled back has none.
The lines are a chain (``templates.store.audit_chain``): nobody without the master key can alter one
or cut lines off unseen.

A one-use token is used up by the line of its use (``AuditRow.token``).
"""

import hashlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.audit_chain import BATCH, LINES, Anchor, Head, append_line
from templates.store.database import Database
from templates.store.identifiers import Clock
from templates.store.lockout import Replayed
from templates.store.schema import AuditRow
from templates.store.secrets import SecretName, Secrets

TENANT_ERASE = "tenant-erase"
_DIGEST = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class By:
    """Who does something, ``"key:<prefix>"`` or ``"operator:<user>"``, and the request's id."""

    actor: str = "program"
    request_id: str | None = None


PROGRAM = By()
"""The actor of what the program does by itself."""


@dataclass(frozen=True)
class Entry:
    """What a line tells, before it has its place in the log.

    `action` and `outcome` are short words, such as ``"erase"`` and ``"erased"``. The subject it was
    done to is named by its pseudonym (:meth:`ReceiptSigner.pseudonym`), never by its id. `detail`
    is what else it was done with: the level of a verification, the prefix of a key, the digest of a
    template's id; `token` the digest of the one-use token that it used up.
    """

    action: str
    outcome: str
    by: By
    tenant: str | None = None
    pseudonym: str | None = None
    detail: str | None = None
    token: str | None = None


@dataclass(frozen=True)
class Line:
    """One line of the audit log, as it is stored."""

    sequence: int
    at: datetime
    tenant: str | None
    actor: str
    action: str
    pseudonym: str | None
    outcome: str
    request_id: str | None
    detail: str | None
    token: str | None = field(repr=False)
    mac: bytes = field(repr=False)


def token_digest(key_prefix: str, value: str) -> str:
    """What the log keeps of a one-use token, by the prefix of its API key and its random id."""
    return hashlib.sha256(encode_parts("token", key_prefix, value)).hexdigest()


def template_digest(template_id: str) -> str:
    """What the log keeps of a template's id, which itself goes when the subject is erased."""
    return hashlib.sha256(encode_parts("template", template_id)).hexdigest()


class AuditLog:
    """The audit log of a deployment."""

    def __init__(self, database: Database, secrets: Secrets, clock: Clock) -> None:
        self._database = database
        self._secrets = secrets
        self._clock = clock

    @property
    def key(self) -> bytes:
        """The secret of the chain."""
        return self._secrets.get(SecretName.CHAIN)

    def append(self, session: Session, entry: Entry, *, key: bytes | None = None) -> None:
        """Add a line inside a write, under the secret of the chain or the one that it begins with.

        :class:`BrokenAuditLog` if the head row is missing or forged. Adding to it would hide that.
        """
        if not all(_DIGEST.fullmatch(name or "0" * 64) for name in (entry.pseudonym, entry.token)):
            raise ValueError("a line names subject and token by digests")
        columns = {
            "at": self._clock().astimezone(UTC).isoformat(timespec="microseconds"),
            "tenant": entry.tenant,
            "actor": entry.by.actor,
            "action": entry.action,
            "pseudonym": entry.pseudonym,
            "outcome": entry.outcome,
            "request_id": entry.by.request_id,
            "detail": entry.detail,
            "token": entry.token,
        }
        append_line(session, key or self.key, columns)

    def record(self, entry: Entry) -> None:
        """Add a line in a transaction of its own."""
        with self._database.write() as session:
            self.append(session, entry)

    def head(self) -> Anchor:
        """Number and MAC of the last line; keep them elsewhere, to verify the log against."""
        with self._database.read() as session:
            return Head.read(session, self.key).last

    def use_of(self, token: str) -> Line | None:
        """Return the line that tells what a one-use token was used for, if it was used."""
        with self._database.read() as session:
            row = session.execute(LINES.where(AuditRow.token == token)).one_or_none()
        return None if row is None else _line(row)

    def require_unused(self, token: str) -> None:
        """Refuse early, with :class:`Replayed`, what a write would refuse; it decides nothing."""
        with self._database.read() as session:
            if is_used(session, token):
                raise Replayed

    def lines(self, *, after: int = 0) -> Iterator[Line]:
        """Lines in their order, beginning after one; read in batches, and not verified."""
        query = LINES.order_by(AuditRow.sequence).limit(BATCH)
        while True:
            with self._database.read() as session:
                rows = session.execute(query.where(AuditRow.sequence > after)).all()
            if not rows:
                return
            yield from map(_line, rows)
            after = rows[-1].sequence

    def page(
        self, tenant: str, *, limit: int, before: int | None = None, pseudonym: str | None = None
    ) -> tuple[list[Line], int | None]:
        """A tenant's lines, the latest first; not those of an erased tenant of the same name.

        Only lines with numbers smaller than `before`, and on one subject where a `pseudonym` is
        given. Returns them, and the number to go on before; None at the end.
        """
        erased = sa.select(sa.func.coalesce(sa.func.max(AuditRow.sequence), 0)).where(
            AuditRow.tenant == tenant,
            AuditRow.action == TENANT_ERASE,
            AuditRow.outcome == "erased",
        )
        query = LINES.where(AuditRow.tenant == tenant, AuditRow.sequence > erased.scalar_subquery())
        if before is not None:
            query = query.where(AuditRow.sequence < before)
        if pseudonym is not None:
            query = query.where(AuditRow.pseudonym == pseudonym)
        query = query.order_by(AuditRow.sequence.desc()).limit(limit + 1)
        with self._database.read() as session:
            rows = session.execute(query).all()
        lines = [_line(row) for row in rows[:limit]]
        return lines, lines[-1].sequence if len(rows) > limit else None


def is_used(session: Session, token: str) -> bool:
    """Whether a one-use token has a line that used it up."""
    query = sa.select(AuditRow.sequence).where(AuditRow.token == token)
    return session.execute(query).first() is not None


def _line(row: Any) -> Line:
    try:
        return Line(**{**row._mapping, "at": datetime.fromisoformat(row.at)})
    except (ValueError, TypeError):
        raise StoreError(
            f"line {row.sequence} of the audit log was altered and cannot be read: "
            "run `veilface audit-log verify`"
        ) from None
