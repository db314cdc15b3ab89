"""The audit log: who did what to which subject, and with which result.

A line names the subject by its pseudonym, and holds nothing of a face. It is written in the
transaction of what it tells of: what is committed has its line, and what is rolled back has none.

The lines are a chain: the MAC of a line is an HMAC-SHA256, under a secret of the deployment, over
its columns and the MAC of the line before. The head row holds both ends of the chain under a MAC.
So an attacker who can write the database, but has no master key, can neither write a line nor cut
lines off unseen. An older state of the whole database, head included, is a true one: only an
:class:`Anchor` that was kept elsewhere shows it.

A one-use token is used up by the line of its use (``AuditRow.token``).
"""

import hashlib
import hmac
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreBusy, StoreError
from templates.keys.sealing import encode_parts
from templates.store.database import Database
from templates.store.identifiers import (
    Clock,
    InvalidIdentifier,
    checked_opaque_id,
    checked_tenant_name,
)
from templates.store.lockout import Replayed
from templates.store.schema import AuditHeadRow, AuditRow
from templates.store.secrets import SecretName, Secrets

BATCH = 1000
MAX_TEXT = 64
TENANT_ERASE = "tenant-erase"

_ANCHOR = re.compile(r"([0-9]{1,18}):([0-9a-f]{64})")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_COLUMNS = tuple(column.key for column in AuditRow.__table__.columns)
_HEAD = ("base_sequence", "base_mac", "sequence", "line_mac")


def _check_text(text: str | None, what: str) -> None:
    if text is not None and not (0 < len(text) <= MAX_TEXT and text.isprintable()):
        raise InvalidIdentifier(
            f"the {what} of an audit line is 1 to {MAX_TEXT} printable characters"
        )


class BrokenAuditLog(StoreError):
    """The head of the audit log is missing or forged, so no line can be added."""


@dataclass(frozen=True)
class Anchor:
    """A point of the chain, kept outside the database: the chain must still lead through it.

    Attributes
    ----------
    sequence
        Number of a line; 0 is before the first.
    mac
        The 32 bytes of its MAC.
    """

    sequence: int
    mac: bytes = field(repr=False)

    def __str__(self) -> str:
        return f"{self.sequence}:{self.mac.hex()}"

    @classmethod
    def parse(cls, text: str) -> "Anchor":
        """Read what ``str`` wrote, or raise :class:`InvalidIdentifier`."""
        match = _ANCHOR.fullmatch(text)
        if match is None:
            raise InvalidIdentifier(
                "an anchor is a line's number, a colon and 64 hexadecimal digits"
            )
        return cls(int(match[1]), bytes.fromhex(match[2]))


START = Anchor(0, bytes(32))


@dataclass(frozen=True)
class Head:
    """Both ends of the chain: it begins after `base` and ends with `last`."""

    base: Anchor
    last: Anchor

    @property
    def ends(self) -> tuple[int, bytes, int, bytes]:
        """Columns of the head row, without its MAC."""
        return self.base.sequence, self.base.mac, self.last.sequence, self.last.mac

    def mac(self, key: bytes) -> bytes:
        """MAC of the head row."""
        return hmac.digest(key, encode_parts("head", *self.ends), hashlib.sha256)


@dataclass(frozen=True)
class By:
    """Who does something.

    Attributes
    ----------
    actor
        ``"key:<prefix>"``, ``"operator:<user>"``, ``"retention"`` or ``"program"``.
    request_id
        Of the request, where it is one.
    """

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

    Attributes
    ----------
    action, outcome
        Short words, such as ``"erase"`` and ``"erased"``.
    by
        Who did it.
    tenant
        Name of the tenant it was done in.
    pseudonym
        Of the subject it was done to (:meth:`ReceiptSigner.pseudonym`). Never a subject id:
        anything but 64 hexadecimal digits is refused.
    detail
        What else it was done with: the level of a verification, the prefix of a key, the digest
        of an enrollment's template id (:func:`template_digest`).
    token
        Of the one-use token that it used up (:func:`token_digest`).
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
    """The first break of the chain.

    Attributes
    ----------
    sequence
        Number of the line at which it breaks.
    what
        ``"altered"``, ``"missing"``, ``"out of order"``, ``"head does not match"`` or
        ``"anchor not in chain"``.
    """

    sequence: int
    what: str


@dataclass(frozen=True)
class Verification:
    """What a walk over the whole chain showed.

    Attributes
    ----------
    lines
        Lines that were good.
    head
        The last of them.
    problem
        The first break; None where the chain is whole.
    """

    lines: int
    head: Anchor
    problem: Problem | None

    @property
    def intact(self) -> bool:
        """Whether nothing is wrong."""
        return self.problem is None


def token_digest(key_prefix: str, value: str) -> str:
    """What the log keeps of a one-use token or challenge: 64 hexadecimal digits.

    Parameters
    ----------
    key_prefix
        Of the API key that asked for it.
    value
        Its random id.
    """
    return hashlib.sha256(encode_parts("token", key_prefix, value)).hexdigest()


def template_digest(template_id: str) -> str:
    """What the log keeps of a template's id, which itself goes when the subject is erased."""
    return hashlib.sha256(encode_parts("template", template_id)).hexdigest()


def line_mac(key: bytes, values: Mapping[str, Any], previous: bytes) -> bytes:
    """MAC of a line.

    Parameters
    ----------
    key
        Secret of the chain, 32 bytes.
    values
        The columns of ``audit_log`` by name; ``mac`` is not looked at.
    previous
        MAC of the line before.

    Raises
    ------
    TypeError
        If a column holds what this program never writes.
    """
    parts: list[str | int] = []
    for name in _COLUMNS[:-1]:
        value = values[name]
        # No column that may be NULL holds a number, so 0 cannot be taken for one.
        if value is not None and type(value) not in (str, int):
            raise TypeError(f"{name} holds a {type(value).__name__}")
        parts.append(0 if value is None else value)
    return hmac.digest(key, encode_parts("line", previous, *parts), hashlib.sha256)


class AuditLog:
    """The audit log of a deployment.

    Parameters
    ----------
    database, secrets, clock
        Where it is kept, what its chain is keyed with, and what time it is.
    """

    def __init__(self, database: Database, secrets: Secrets, clock: Clock) -> None:
        self._database = database
        self._secrets = secrets
        self._clock = clock

    @property
    def key(self) -> bytes:
        """The secret of the chain."""
        return self._secrets.get(SecretName.CHAIN)

    def begin(self, connection: Connection, key: bytes, base: Anchor = START) -> None:
        """Begin a chain under a new key, in a write; a head that is there already is replaced."""
        head = Head(base, base)
        connection.execute(sa.delete(AuditHeadRow))
        connection.execute(sa.insert(AuditHeadRow).values(id=1, **head_columns(head, key)))

    def append(self, connection: Connection, entry: Entry, *, key: bytes | None = None) -> None:
        """Add a line inside a write, under the secret of the chain or the one that it begins with.

        Raises
        ------
        BrokenAuditLog
            If the head row is missing or forged. Adding to it would hide that.
        """
        key = key or self.key
        head = read_head(connection, key)
        at = self._clock().astimezone(UTC).isoformat(timespec="microseconds")
        values: dict[str, Any] = {
            "sequence": head.last.sequence + 1,
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
        values["mac"] = line_mac(key, values, head.last.mac)
        connection.execute(_ADD_LINE, values)
        moved = Head(head.base, Anchor(values["sequence"], values["mac"]))
        connection.execute(MOVE_HEAD, head_columns(moved, key))

    def record(self, entry: Entry) -> None:
        """Add a line in a transaction of its own."""
        self._database.write(lambda connection: self.append(connection, entry))

    def head(self) -> Anchor:
        """Number and MAC of the last line; keep them elsewhere, to verify the log against.

        Raises
        ------
        BrokenAuditLog
            If the head row is missing or forged.
        """
        return self._database.read(lambda connection: read_head(connection, self.key)).last

    def use_of(self, token: str) -> Line | None:
        """Return the line that tells what a one-use token was used for, if it was used."""
        query = LINES.where(AuditRow.token == token)
        row = self._database.read(lambda connection: connection.execute(query).one_or_none())
        return None if row is None else _line(row)

    def require_unused(self, token: str) -> None:
        """Refuse early what a write would refuse; it decides nothing itself.

        Raises
        ------
        Replayed
        """
        if self._database.read(lambda connection: is_used(connection, token)):
            raise Replayed

    def lines(self, *, after: int = 0, batch: int = BATCH) -> Iterator[Line]:
        """Lines in their order, beginning after one; read in batches, and not verified."""
        while rows := self._database.read(partial(_rows_after, after=after, most=batch)):
            yield from map(_line, rows)
            after = rows[-1].sequence

    def page(
        self, tenant: str, *, limit: int, before: int | None = None, pseudonym: str | None = None
    ) -> tuple[list[Line], int | None]:
        """A tenant's lines, the latest first; not those of an erased tenant of the same name.

        Parameters
        ----------
        tenant
            Its name.
        limit
            Lines of the page.
        before
            Only lines with smaller numbers.
        pseudonym
            Only lines on this subject.

        Returns
        -------
        The lines, and the number to go on before; None at the end.
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

    def verify(
        self,
        *,
        anchor: Anchor | None = None,
        seen: Callable[[Mapping[str, Any]], None] | None = None,
        progress: Callable[[int], None] | None = None,
        batch: int = BATCH,
    ) -> Verification:
        """Walk over the whole chain beside a service in use, up to the first break.

        Parameters
        ----------
        anchor
            An earlier head. Without one, an old state of the whole log is not told from a new one.
        seen
            Called with the columns of each good line.
        progress
            Called after each batch with the number of its lines.
        batch
            Lines read at once, and in memory.

        Raises
        ------
        SealError
            If the master key is not the one that the log was written with.
        """
        key = self.key
        try:
            base = self._database.read(lambda connection: read_head(connection, key)).base
        except BrokenAuditLog:
            return Verification(0, START, Problem(0, "head does not match"))
        last, count, is_anchored = base, 0, anchor in (None, base)
        while True:
            # The head first: a line that comes between the two reads is not beyond the head.
            head, rows = self._database.read(
                lambda connection, after=last.sequence: (  # type: ignore[misc]
                    read_head(connection, key),
                    # From the very first row: one that was slipped in before the base is seen too.
                    _rows_after(connection, None if after == base.sequence else after, batch),
                )
            )
            if head.base != base:
                raise StoreBusy("lines were archived meanwhile: verify the log again")
            for row in rows:
                values = row._mapping
                if what := line_break(key, values, last):
                    number = min(values["sequence"], last.sequence + 1)
                    return Verification(count, last, Problem(number, what))
                last, count = Anchor(values["sequence"], values["mac"]), count + 1
                is_anchored |= last == anchor
                if seen is not None:
                    seen(values)
            if progress is not None and rows:
                progress(len(rows))
            if not rows:
                break
        if head.last != last:
            missing = head.last.sequence > last.sequence
            what = "missing" if missing else "head does not match"
            return Verification(count, last, Problem(last.sequence + missing, what))
        if not is_anchored and anchor is not None:
            return Verification(count, last, Problem(anchor.sequence, "anchor not in chain"))
        return Verification(count, last, None)

    def lines_after(self, connection: Connection, last: Anchor) -> Iterator[Mapping[str, Any]]:
        """Columns of the lines after the last one of a walk, up to the first break."""
        for row in _rows_after(connection, last.sequence):
            if line_break(self.key, row._mapping, last):
                return
            last = Anchor(row.sequence, row.mac)
            yield row._mapping

    def __repr__(self) -> str:
        return "AuditLog()"


# Made once: building a statement costs more than running it, and every write appends a line.
_ADD_LINE = sa.insert(AuditRow.__table__)  # type: ignore[arg-type]
MOVE_HEAD = sa.update(AuditHeadRow.__table__)  # type: ignore[arg-type]
# The MAC as it is: SQLite keeps any value in any column, and an altered one must still arrive.
LINES: Any = sa.select(
    *(getattr(AuditRow, name) for name in _COLUMNS[:-1]),
    sa.type_coerce(AuditRow.mac, sa.types.NullType()).label("mac"),
)
_HEADS: Any = sa.select(
    *(
        sa.type_coerce(getattr(AuditHeadRow, name), sa.types.NullType()).label(name)
        for name in (*_HEAD, "mac")
    )
)


def is_used(connection: Connection, token: str) -> bool:
    """Whether a one-use token has a line that used it up."""
    query = sa.select(AuditRow.sequence).where(AuditRow.token == token)
    return connection.execute(query).first() is not None


def read_head(connection: Connection, key: bytes) -> Head:
    """Read both ends of the chain.

    Raises
    ------
    BrokenAuditLog
        If the row is missing or forged.
    """
    rows = connection.execute(_HEADS).all()
    if len(rows) == 1:
        row = rows[0]
        with_types = [type(value) for value in row]
        if with_types == [int, bytes, int, bytes, bytes]:
            head = Head(Anchor(row.base_sequence, row.base_mac), Anchor(row.sequence, row.line_mac))
            if hmac.compare_digest(head.mac(key), row.mac):
                return head
    raise BrokenAuditLog(
        "the head of the audit log is missing or was altered: "
        "run `veilface audit-log verify`, and restore the database from a backup"
    )


def head_columns(head: Head, key: bytes) -> dict[str, Any]:
    """Columns of the head row."""
    return {**dict(zip(_HEAD, head.ends, strict=True)), "mac": head.mac(key)}


def _rows_after(
    connection: Connection, after: int | None, most: int | None = None
) -> Sequence[Any]:
    """Lines in their order, after the number of one, or from the very first row."""
    query = LINES.order_by(AuditRow.sequence).limit(most)
    if after is not None:
        query = query.where(AuditRow.sequence > after)
    return connection.execute(query).all()


def line_break(key: bytes, values: Mapping[str, Any], last: Anchor) -> str | None:
    """Say why a line does not follow; None where it does."""
    if values["sequence"] != last.sequence + 1:
        return "missing" if values["sequence"] > last.sequence else "out of order"
    try:
        expected = line_mac(key, values, last.mac)
    except TypeError:
        return "altered"
    mac = values["mac"]
    is_true = isinstance(mac, bytes) and hmac.compare_digest(expected, mac)
    return None if is_true else "altered"


def _line(row: Any) -> Line:
    try:
        return Line(**{**row._mapping, "at": datetime.fromisoformat(row.at)})
    except (ValueError, TypeError):
        raise StoreError(
            f"line {row.sequence} of the audit log was altered and cannot be read: "
            "run `veilface audit-log verify`"
        ) from None
