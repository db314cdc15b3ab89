"""The chain of the audit log: how each line is bound to the one before, and what breaks it.

The hash of a line is an HMAC-SHA256, under a key of the deployment, over all of its columns and the
hash of the line before. The head row holds the number and hash of the last line and a MAC of both.
Who can write the database but has no master key can therefore neither write a line nor cut the end
off unseen. Two things only an :class:`Anchor` that was kept elsewhere shows: an older state of the
whole log, its head included, put back, which is a true one; and a log whose lines, MAC and key were
all removed, which the next upgrade of the schema takes for one that never began.

A renewal of the key ends the lines of the old one and begins those of the new one
(:class:`LineKeys`); the head is always under the new one.
"""

import hashlib
import hmac
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.identifiers import InvalidIdentifier

HASH_BYTES = 32
MAX_PROBLEMS = 1000

ALTERED = "altered"
MISSING = "missing"
OUT_OF_ORDER = "out of order"
TWICE = "lines that share a number"
HEAD_MISMATCH = "head does not match"
ANCHOR_NOT_IN_CHAIN = "anchor not in chain"

_ANCHOR = re.compile(r"([0-9]{1,18}):([0-9a-f]{64})")


@dataclass(frozen=True)
class Anchor:
    """A point of the chain, kept outside the database: the chain must still lead through it.

    Attributes
    ----------
    sequence
        Number of a line; 0 is before the first.
    hash
        The 32 bytes of its hash.
    """

    sequence: int
    hash: bytes = field(repr=False)

    def __str__(self) -> str:
        return f"{self.sequence}:{self.hash.hex()}"

    @classmethod
    def parse(cls, text: str) -> "Anchor":
        """Read what ``str`` wrote, or raise :class:`InvalidIdentifier`."""
        match = _ANCHOR.fullmatch(text)
        if match is None:
            raise InvalidIdentifier(
                "an anchor is a line's number, a colon and 64 hexadecimal digits"
            )
        return cls(int(match[1]), bytes.fromhex(match[2]))


START = Anchor(0, bytes(HASH_BYTES))


@dataclass(frozen=True)
class Line:
    """One line of the audit log, with the columns of its table.

    `nonce` is a keyed digest of the nonce that a decision used up; None for most lines.
    """

    sequence: int
    at: datetime
    tenant: str | None
    actor: str | None
    action: str
    pseudonym: str | None
    outcome: str
    request_id: str | None
    detail: str | None
    nonce: str | None = field(repr=False)
    previous_hash: bytes = field(repr=False)
    hash: bytes = field(repr=False)

    @classmethod
    def read(cls, values: Mapping[str, Any]) -> "Line":
        """Make a line of its columns: `sequence` a number, the rest texts or their UTF-8 bytes.

        Raises
        ------
        ValueError
            If a column holds what this program does not write.
        """
        columns: dict[str, Any] = {name: values[name] for name in cls.__dataclass_fields__}
        for name in columns.keys() - {"sequence", "previous_hash", "hash"}:
            columns[name] = _text(columns[name])
        line = cls(**{**columns, "at": _time(columns["at"])})
        for own_hash in (line.previous_hash, line.hash):
            if not isinstance(own_hash, bytes) or len(own_hash) != HASH_BYTES:
                raise ValueError("a hash has 32 bytes")
        return line


@dataclass(frozen=True)
class Problem:
    """Something wrong in the log.

    Attributes
    ----------
    sequence
        Number of the line, or of the first one of several.
    what
        ``"altered"``, ``"missing"``, ``"out of order"``, ``"lines that share a number"``,
        ``"head does not match"`` or ``"anchor not in chain"``.
    through
        Number of the last line that is missing; None where it is about one line.
    """

    sequence: int
    what: str
    through: int | None = None


@dataclass(frozen=True)
class Verification:
    """What a walk over the whole chain found.

    Attributes
    ----------
    lines
        Lines read.
    head
        The last line read; :data:`START` in an empty log.
    problems
        The first thousand.
    unlisted
        Problems beyond those.
    """

    lines: int
    head: Anchor
    problems: tuple[Problem, ...]
    unlisted: int = 0

    @property
    def intact(self) -> bool:
        """Whether nothing is wrong."""
        return not self.problems


def line_hash(key: bytes, values: Mapping[str, str | int | bytes | datetime | None]) -> bytes:
    """Hash of a line: of all its columns but the hash itself, in the order of :class:`Line`.

    A line without a nonce is hashed as it was before there were any: the number of parts tells.
    """
    unhashed = {"hash", "nonce"} if values["nonce"] is None else {"hash"}
    parts = [_part(values[name]) for name in Line.__dataclass_fields__ if name not in unhashed]
    return hmac.digest(key, encode_parts("line", *parts), hashlib.sha256)


@dataclass(frozen=True)
class LineKeys:
    """The keys of a chain: a line is good under the key of its own time only.

    Whoever took a key that was retired since cannot add to the lines of its time, because the
    first line under the next key holds the hash of the last of them.

    Attributes
    ----------
    current
        Key of the head, and of the lines that come.
    retired
        Each with the number of the last line of its time, the oldest first.
    """

    current: bytes = field(repr=False)
    retired: tuple[tuple[int, bytes], ...] = field(default=(), repr=False)

    def of(self, sequence: int) -> bytes:
        """Key of the line of this number."""
        for through, key in self.retired:
            if sequence <= through:
                return key
        return self.current


def is_true_line(keys: LineKeys, line: Line) -> bool:
    """Whether a line is as it was written."""
    return hmac.compare_digest(line_hash(keys.of(line.sequence), vars(line)), line.hash)


def true_line(keys: LineKeys, values: Mapping[str, Any]) -> Line | None:
    """:meth:`Line.read`; None where the line is not as it was written."""
    try:
        line = Line.read(values)
    except ValueError:
        return None
    return line if is_true_line(keys, line) else None


def head_mac(key: bytes, head: Anchor) -> bytes:
    """MAC of the head row."""
    return hmac.digest(key, encode_parts("head", head.sequence, head.hash), hashlib.sha256)


def is_head(key: bytes, head: Anchor, mac: bytes) -> bool:
    """Whether the head row is one that the holder of the key wrote; at the start it has a MAC too.

    The migration that makes the row has no key and leaves the MAC empty; the one who makes the key
    writes it, in one transaction. So an empty one beside a key is forged.
    """
    return hmac.compare_digest(head_mac(key, head), mac)


class Chain:
    """A walk along the chain, from before its first line; keeps a bounded number of problems."""

    def __init__(self, keys: LineKeys, *, anchor: Anchor | None = None) -> None:
        self._keys = keys
        self._anchor = anchor
        self._last = START
        self._trusted = True  # whether the hash of the last line is its true one
        self._anchored = anchor in (None, START)
        self._lines = 0
        self._problems: list[Problem] = []
        self._unlisted = 0

    def step(self, values: Mapping[str, Any]) -> None:
        """Check the next line, given as :meth:`Line.read` takes it."""
        sequence, expected = values["sequence"], self._last.sequence + 1
        line = true_line(self._keys, values)
        self._lines += 1
        if sequence > expected:
            self._report(Problem(expected, MISSING, through=sequence - 1))
        if line is None:
            self._report(Problem(sequence, ALTERED))
        elif sequence < expected or not self._follows(line):
            self._report(Problem(sequence, OUT_OF_ORDER))
        if sequence < expected:
            return  # no link of the chain
        self._last = Anchor(sequence, values["hash"] or b"")  # where it lost its NOT NULL
        self._trusted = line is not None
        self._anchored |= self._last == self._anchor

    def _follows(self, line: Line) -> bool:
        # Beside a gap or an altered line, which are reported, there is nothing to compare with.
        comparable = self._trusted and line.sequence == self._last.sequence + 1
        return not comparable or line.previous_hash == self._last.hash

    def end(self, head: Anchor | None, mac: bytes, *, held: int) -> Verification:
        """Compare the end of the walk with the head row.

        Parameters
        ----------
        head, mac
            The head row; None where it is missing.
        held
            Lines that the table holds up to the last one of the walk.
        """
        last = self._last
        if held != self._lines:
            self._report(Problem(last.sequence, TWICE))
        if head is None or not is_head(self._keys.current, head, mac):
            self._report(Problem(last.sequence, HEAD_MISMATCH))
        elif head.sequence > last.sequence:
            self._report(Problem(last.sequence + 1, MISSING, through=head.sequence))
        elif head.sequence < last.sequence or (self._trusted and head.hash != last.hash):
            self._report(Problem(last.sequence, HEAD_MISMATCH))
        if not self._anchored and self._anchor is not None:
            self._report(Problem(self._anchor.sequence, ANCHOR_NOT_IN_CHAIN))
        return Verification(self._lines, last, tuple(self._problems), self._unlisted)

    def _report(self, problem: Problem) -> None:
        if len(self._problems) < MAX_PROBLEMS:
            self._problems.append(problem)
        else:
            self._unlisted += 1


def read_line(values: Mapping[str, Any]) -> Line:
    """:meth:`Line.read` for a reader of the log, who is sent to the verification."""
    try:
        return Line.read(values)
    except ValueError:
        raise StoreError(
            f"line {values['sequence']} of the audit log was altered and cannot be read: "
            "run `veilface audit-log verify`"
        ) from None


def _part(value: str | int | bytes | datetime | None) -> str | int | bytes:
    # No column that may be None holds a number, so a number cannot be taken for one.
    match value:
        case None:
            return 0
        case datetime():
            return value.astimezone(UTC).isoformat(timespec="microseconds")
        case _:
            return value


def _text(value: str | bytes | None) -> str | None:
    return value.decode() if isinstance(value, bytes) else value


def _time(text: str | None) -> datetime:
    time = datetime.fromisoformat(text or "")
    if time.tzinfo is not None or time.isoformat(" ", "microseconds") != text:
        raise ValueError("not a time as it is written here")
    return time.replace(tzinfo=UTC)
