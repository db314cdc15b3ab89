"""The audit log: who did what to which subject, and with which result.

A line names the subject by its pseudonym, and holds nothing of a face. It is written in the
transaction of what it tells of: what is committed has its line, and what is rolled back has none.
The lines are a chain (``templates.store.audit_chain``): nobody without the master key can alter one
or cut lines off unseen.

A one-use token is used up by the line of its use (``AuditRow.token``).
"""

import hashlib
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.audit_chain import (
    LINES,
    START,
    Anchor,
    BrokenAuditLog,
    append_line,
    line_break,
    read_head,
    rows_after,
)
from templates.store.database import Database
from templates.store.identifiers import (
    Clock,
    InvalidIdentifier,
    checked_opaque_id,
    checked_tenant_name,
)
from templates.store.lockout import Replayed
from templates.store.schema import AuditRow
from templates.store.secrets import SecretName, Secrets

BATCH = 1000
MAX_TEXT = 64
TENANT_ERASE = "tenant-erase"

_DIGEST = re.compile(r"[0-9a-f]{64}")


def _check_text(text: str | None, what: str) -> None:
    if text is not None and not (0 < len(text) <= MAX_TEXT and text.isprintable()):
        raise InvalidIdentifier(
            f"the {what} of an audit line is 1 to {MAX_TEXT} printable characters"
        )


@dataclass(frozen=True)
class By:
    """Who does something, ``"key:<prefix>"`` or ``"operator:<user>"``, and the request's id."""

    actor: str = "program"
    request_id: str | None = None

    def __post_init__(self) -> None:
        _check_text(self.actor, "actor")
        _check_text(self.request_id, "request id")


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

    def __post_init__(self) -> None:
        checked_opaque_id(self.action, what="audit action")
        checked_opaque_id(self.outcome, what="audit outcome")
        if self.tenant is not None:
            checked_tenant_name(self.tenant)
        for digest in (self.pseudonym, self.token):
            if digest is not None and not _DIGEST.fullmatch(digest):
                raise InvalidIdentifier(
                    "the audit log names a subject by its pseudonym and a token by its digest only"
                )
        _check_text(self.detail, "detail")


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


@dataclass(frozen=True)
class Problem:
    """The first break of the chain: the number of the line, and what is wrong there."""

    sequence: int
    what: str


@dataclass(frozen=True)
class Verification:
    """What a walk over the whole chain showed: good lines, the last of them, the first break."""

    lines: int
    head: Anchor
    problem: Problem | None

    @property
    def intact(self) -> bool:
        """Whether nothing is wrong."""
        return self.problem is None


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

    def append(self, connection: Connection, entry: Entry, *, key: bytes | None = None) -> None:
        """Add a line inside a write, under the secret of the chain or the one that it begins with.

        Raises
        ------
        BrokenAuditLog
            If the head row is missing or forged. Adding to it would hide that.
        """
        at = self._clock().astimezone(UTC).isoformat(timespec="microseconds")
        columns = {
            "at": at,
            "tenant": entry.tenant,
            "actor": entry.by.actor,
            "action": entry.action,
            "pseudonym": entry.pseudonym,
            "outcome": entry.outcome,
            "request_id": entry.by.request_id,
            "detail": entry.detail,
            "token": entry.token,
        }
        append_line(connection, key or self.key, columns)

    def record(self, entry: Entry) -> None:
        """Add a line in a transaction of its own."""
        self._database.write(lambda connection: self.append(connection, entry))

    def head(self) -> Anchor:
        """Number and MAC of the last line; keep them elsewhere, to verify the log against."""
        return self._database.read(lambda connection: read_head(connection, self.key)).last

    def use_of(self, token: str) -> Line | None:
        """Return the line that tells what a one-use token was used for, if it was used."""
        query = LINES.where(AuditRow.token == token)
        row = self._database.read(lambda connection: connection.execute(query).one_or_none())
        return None if row is None else _line(row)

    def require_unused(self, token: str) -> None:
        """Refuse early, with :class:`Replayed`, what a write would refuse; it decides nothing."""
        if self._database.read(lambda connection: is_used(connection, token)):
            raise Replayed

    def lines(self, *, after: int = 0, batch: int = BATCH) -> Iterator[Line]:
        """Lines in their order, beginning after one; read in batches, and not verified."""
        while rows := self._database.read(partial(rows_after, after=after, most=batch)):
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
        rows = self._database.read(lambda connection: connection.execute(query).all())
        lines = [_line(row) for row in rows[:limit]]
        return lines, lines[-1].sequence if len(rows) > limit else None

    def verify(self, *, anchor: Anchor | None = None, batch: int = BATCH) -> Verification:
        """Walk over the whole chain, of one moment, beside a service in use; see :meth:`walk`."""
        key = self.key
        return self._database.snapshot(
            lambda connection: self.walk(connection, key, anchor=anchor, batch=batch)
        )

    def walk(
        self,
        connection: Connection,
        key: bytes,
        *,
        anchor: Anchor | None = None,
        seen: Callable[[Mapping[str, Any]], None] | None = None,
        progress: Callable[[int], None] | None = None,
        batch: int = BATCH,
    ) -> Verification:
        """Walk over the whole chain, up to the first break, in a snapshot.

        `seen` is called with the columns of each good line, `progress` after each batch with the
        number of its lines. Without an `anchor`, an earlier head, an old state of the whole log is
        not told from a new one.
        """
        try:
            head = read_head(connection, key)
        except BrokenAuditLog:
            return Verification(0, START, Problem(0, "head does not match"))
        last, count, is_anchored = head.base, 0, anchor in (None, head.base)
        # From the very first row: one that was slipped in before the base is seen too.
        after = None
        while rows := rows_after(connection, after, batch):
            for row in rows:
                values = row._mapping
                if what := line_break(key, values, last):
                    number = min(values["sequence"], last.sequence + 1)
                    return Verification(count, last, Problem(number, what))
                last, count = Anchor(values["sequence"], values["mac"]), count + 1
                is_anchored |= last == anchor
                if seen is not None:
                    seen(values)
            after = last.sequence
            if progress is not None:
                progress(len(rows))
        if head.last != last:
            missing = head.last.sequence > last.sequence
            what = "missing" if missing else "head does not match"
            return Verification(count, last, Problem(last.sequence + missing, what))
        if not is_anchored and anchor is not None:
            return Verification(count, last, Problem(anchor.sequence, "anchor not in chain"))
        return Verification(count, last, None)

    def __repr__(self) -> str:
        return "AuditLog()"


def is_used(connection: Connection, token: str) -> bool:
    """Whether a one-use token has a line that used it up."""
    query = sa.select(AuditRow.sequence).where(AuditRow.token == token)
    return connection.execute(query).first() is not None


def _line(row: Any) -> Line:
    try:
        return Line(**{**row._mapping, "at": datetime.fromisoformat(row.at)})
    except (ValueError, TypeError):
        raise StoreError(
            f"line {row.sequence} of the audit log was altered and cannot be read: "
            "run `veilface audit-log verify`"
        ) from None
