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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.identifiers import InvalidIdentifier
from templates.store.schema import AuditHeadRow, AuditRow

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


def begin_chain(connection: Connection, key: bytes, base: Anchor = START) -> None:
    """Begin a chain under a new key, in a write; a head that is there already is replaced."""
    connection.execute(sa.delete(AuditHeadRow))
    columns = head_columns(Head(base, base), key)
    connection.execute(sa.insert(AuditHeadRow).values(id=1, **columns))


def append_line(connection: Connection, key: bytes, columns: Mapping[str, Any]) -> None:
    """Add a line inside a write, from all its columns except the number and the MAC.

    Raises
    ------
    BrokenAuditLog
        If the head row is missing or forged. Adding to it would hide that.
    """
    head = read_head(connection, key)
    values = {**columns, "sequence": head.last.sequence + 1}
    values["mac"] = line_mac(key, values, head.last.mac)
    connection.execute(_ADD_LINE, values)
    move_head(connection, key, Head(head.base, Anchor(values["sequence"], values["mac"])))


def move_head(connection: Connection, key: bytes, head: Head) -> None:
    """Replace both ends of the chain, in a write."""
    connection.execute(_MOVE_HEAD, head_columns(head, key))


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


def rows_after(connection: Connection, after: int | None, most: int | None = None) -> Sequence[Any]:
    """Lines in their order, after the number of one, or from the very first row."""
    query = LINES.order_by(AuditRow.sequence).limit(most)
    if after is not None:
        query = query.where(AuditRow.sequence > after)
    return connection.execute(query).all()


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
