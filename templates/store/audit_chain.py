"""The chain of the audit log: what makes a line that was altered, added or cut off visible.

The MAC of a line is an HMAC-SHA256, under a secret of the deployment, over its columns and the MAC
of the line before. The head row holds both ends of the chain under a MAC. So an attacker who can
write the database, but has no master key, can neither write a line nor cut lines off unseen. An
older state of the whole database, head included, is a true one: only an :class:`Anchor` that was
kept elsewhere shows it.
"""

import hashlib
import hmac
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.identifiers import InvalidIdentifier
from templates.store.schema import AuditHeadRow, AuditRow

BATCH = 1000

_ANCHOR = re.compile(r"([0-9]{1,18}):([0-9a-f]{64})")
_COLUMNS = tuple(column.key for column in AuditRow.__table__.columns)
_HEAD = ("base_sequence", "base_mac", "sequence", "line_mac")

# Made once: building a statement costs more than running it, and every write appends a line.
_ADD_LINE = sa.insert(AuditRow.__table__)  # type: ignore[arg-type]
_MOVE_HEAD = sa.update(AuditHeadRow.__table__)  # type: ignore[arg-type]
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


@dataclass(eq=False)
class ChainBreak(Exception):
    """The first break of the chain: the number of the line, and what is wrong there."""

    sequence: int
    what: str


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

    @classmethod
    def read(cls, session: Session, key: bytes) -> "Head":
        """Read both ends of the chain; :class:`BrokenAuditLog` if the row is missing or forged."""
        rows = session.execute(_HEADS).all()
        if len(rows) == 1:
            row = rows[0]
            with_types = [type(value) for value in row]
            if with_types == [int, bytes, int, bytes, bytes]:
                head = cls(
                    Anchor(row.base_sequence, row.base_mac), Anchor(row.sequence, row.line_mac)
                )
                if hmac.compare_digest(head.columns(key)["mac"], row.mac):
                    return head
        raise BrokenAuditLog(
            "the head of the audit log is missing or was altered: "
            "run `veilface audit-log verify`, and restore the database from a backup"
        )

    def columns(self, key: bytes) -> dict[str, Any]:
        """Columns of the head row, with its MAC."""
        ends = self.base.sequence, self.base.mac, self.last.sequence, self.last.mac
        mac = hmac.digest(key, encode_parts("head", *ends), hashlib.sha256)
        return {**dict(zip(_HEAD, ends, strict=True)), "mac": mac}

    def replace(self, session: Session, key: bytes) -> None:
        """Put both ends into the head row, in a write."""
        session.execute(_MOVE_HEAD, self.columns(key))


def begin_chain(session: Session, key: bytes, base: Anchor = START) -> None:
    """Begin a chain under a new key, in a write; a head that is there already is replaced."""
    session.execute(sa.delete(AuditHeadRow))
    session.add(AuditHeadRow(id=1, **Head(base, base).columns(key)))


def append_line(session: Session, key: bytes, columns: Mapping[str, Any]) -> None:
    """Add a line inside a write, from all its columns except the number and the MAC.

    :class:`BrokenAuditLog` if the head row is missing or forged. Adding to it would hide that.
    """
    head = Head.read(session, key)
    values = {**columns, "sequence": head.last.sequence + 1}
    values["mac"] = line_mac(key, values, head.last.mac)
    session.execute(_ADD_LINE, values)
    Head(head.base, Anchor(values["sequence"], values["mac"])).replace(session, key)


def line_mac(key: bytes, values: Mapping[str, Any], previous: bytes) -> bytes:
    """MAC of a line: of its columns by name, and of the MAC of the line before.

    A column that holds what this program never writes is a TypeError.
    """
    parts: list[str | int] = []
    for name in _COLUMNS[:-1]:
        value = values[name]
        # No column that may be NULL holds a number, so 0 cannot be taken for one.
        if value is not None and type(value) not in (str, int):
            raise TypeError(f"{name} holds a {type(value).__name__}")
        parts.append(0 if value is None else value)
    return hmac.digest(key, encode_parts("line", previous, *parts), hashlib.sha256)


def good_lines(
    session: Session,
    key: bytes,
    head: Head,
    *,
    through: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Iterator[Mapping[str, Any]]:
    """Yield the columns of each line that follows on the one before, in a snapshot or a write.

    Through a number, or else to the end, which must be that of the head. `progress` is called after
    each batch with the number of its lines.

    Raises
    ------
    ChainBreak
    """
    last = head.base
    # From the very first row: one that was slipped in before the base is seen too.
    query = LINES.order_by(AuditRow.sequence).execution_options(yield_per=BATCH)
    if through is not None:
        query = query.where(AuditRow.sequence <= through)
    for rows in session.execute(query).partitions():
        for row in rows:
            columns = row._asdict()
            if what := _fault(key, columns, last):
                raise ChainBreak(min(row.sequence, last.sequence + 1), what)
            yield columns
            last = Anchor(row.sequence, row.mac)
        if progress is not None:
            progress(len(rows))
    if through is None and head.last != last:
        missing = head.last.sequence > last.sequence
        what = "missing" if missing else "head does not match"
        raise ChainBreak(last.sequence + missing, what)


def _fault(key: bytes, values: Mapping[str, Any], last: Anchor) -> str | None:
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
