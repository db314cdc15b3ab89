"""The audit log: who did what to which subject, and with which result; lines are only ever added.

A line names the subject by its pseudonym, and holds nothing of a face. It is written in the
transaction of what it tells of: what is committed has its line, and what is rolled back has none.
The chain that shows whether a line was altered, removed or moved is in
``templates.store.audit_chain``; triggers of the database refuse to change or remove a line at all.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import partial

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import derive_key
from templates.store.audit_chain import (
    START,
    Anchor,
    Chain,
    Line,
    LineKeys,
    Verification,
    head_mac,
    is_head,
    line_hash,
    read_line,
    true_line,
)
from templates.store.audit_rows import (
    read_end,
    read_head,
    read_lines,
    read_tenant_erasures,
    read_tenant_lines,
)
from templates.store.database import Database
from templates.store.deployment import Secrets
from templates.store.identifiers import (
    Clock,
    InvalidIdentifier,
    checked_opaque_id,
    checked_tenant_name,
)
from templates.store.schema import AuditHeadRow, AuditRow
from templates.store.secret import Secret, SecretName

BATCH = 1000
SCANNED = 50_000
MAX_ACTOR = 64
MAX_REQUEST_ID = 64
MAX_DETAIL = 64

TENANT_ERASE = "tenant-erase"
RENEWAL = "secrets-renew"

_BEGIN_LOCK = "veilface audit chain"
_DIGEST = re.compile(r"[0-9a-f]{64}")
# Made once: building a statement costs more than running it, and every write appends a line.
_ADD_LINE = sa.insert(AuditRow.__table__)  # type: ignore[arg-type]
_MOVE_HEAD = sa.update(AuditHeadRow.__table__)  # type: ignore[arg-type]


class BrokenAuditLog(StoreError):
    """The head of the audit log, or its key, is missing or forged, so no line can be added."""


def is_digest(text: str) -> bool:
    """Whether a text is 64 hexadecimal digits, as a pseudonym is."""
    return _DIGEST.fullmatch(text) is not None


def _checked_text(text: str | None, longest: int, what: str) -> None:
    if text is not None and not (0 < len(text) <= longest and text.isprintable()):
        raise InvalidIdentifier(
            f"the {what} of an audit line is 1 to {longest} printable characters"
        )


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
        _checked_text(self.actor, MAX_ACTOR, "actor")
        _checked_text(self.request_id, MAX_REQUEST_ID, "request id")


PROGRAM = By()
"""Whoever does something without saying who."""


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
        What else it was done with: the level of a verification, the prefix of a key.
    nonce
        Keyed digest, 64 hexadecimal digits, of the nonce that it used up.
    """

    action: str
    outcome: str
    by: By
    tenant: str | None = None
    pseudonym: str | None = None
    detail: str | None = None
    nonce: str | None = None

    def __post_init__(self) -> None:
        checked_opaque_id(self.action, what="audit action")
        checked_opaque_id(self.outcome, what="audit outcome")
        if self.tenant is not None:
            checked_tenant_name(self.tenant)
        if self.pseudonym is not None and not is_digest(self.pseudonym):
            raise InvalidIdentifier("the audit log names a subject by its pseudonym only")
        _checked_text(self.detail, MAX_DETAIL, "detail")
        if self.nonce is not None and not is_digest(self.nonce):
            raise InvalidIdentifier("the audit log keeps the digest of a nonce only")


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
        self._row_keys: dict[bytes, bytes] = {}

    def begin(self) -> None:
        """Make the key of a chain that never began, and the MAC of its head; else do nothing.

        The migration made the head row, and has no key. Nothing but this makes the key: once it is
        gone, it is not made anew while a line or the MAC of a head tells that there was one. Where
        all three are gone, the log is taken for one that never began: then an anchor from before
        is what shows that lines are missing.

        Raises
        ------
        BrokenAuditLog
            If the key is gone.
        """
        self._database.write(self._begin, lock=_BEGIN_LOCK)

    def _begin(self, connection: Connection) -> None:
        secret = self._secrets.make(connection, SecretName.CHAIN)
        if secret is None:
            return
        head, mac = read_head(connection)
        written = connection.execute(sa.select(sa.exists(AuditRow.sequence))).scalar_one()
        if written or head != START or mac:
            raise _without_key()  # which takes back the key that was made
        connection.execute(sa.update(AuditHeadRow).values(mac=head_mac(secret.value, START)))

    def prepare(self) -> None:
        """Open the key of the chain; to be called before a transaction that appends.

        Raises
        ------
        BrokenAuditLog
            If there is none.
        SealError
            If the master key that wrapped it is missing.
        """
        self.row_key()

    def line_keys(self) -> LineKeys:
        """Keys of the chain.

        Raises
        ------
        BrokenAuditLog
            If they are gone.
        """
        chain = self._chain()
        return LineKeys(chain.value, tuple((key.line, key.value) for key in chain.retired))

    def row_key(self) -> bytes:
        """Key of the MACs of rows, derived from the chain's: they are lost together.

        Raises
        ------
        BrokenAuditLog
            If the key of the chain is gone.
        """
        return self.row_key_of(self._key())

    def row_key_of(self, chain_key: bytes) -> bytes:
        """:meth:`row_key` of another key of the chain than the one in force."""
        if chain_key not in self._row_keys:
            self._row_keys[chain_key] = derive_key(chain_key, "rows")
        return self._row_keys[chain_key]

    def append(self, connection: Connection, entry: Entry) -> int:
        """Add a line inside a transaction that is open already; returns its number.

        The lines of all processes are added one after the other, each waiting for the commit of
        the one before: whatever follows this call in the transaction makes every other write wait.
        Nothing follows but rows that carry the number of their line, which the transaction has
        locked before. As everybody takes the head row last, no two of them wait for each other.

        Raises
        ------
        BrokenAuditLog
            If the head row is missing or forged. Adding to it would hide that.
        RuntimeError
            If :meth:`prepare` was not called before the transaction: opening the key is a
            transaction of its own, which on SQLite would wait for this one.
        """
        chain = self._secrets.opened(SecretName.CHAIN)
        if chain is None:
            raise RuntimeError("call AuditLog.prepare before the transaction")
        return self._append(connection, entry, chain.value).sequence

    def hand_over(self, connection: Connection, by: By) -> tuple[Secret, Anchor]:
        """Renew the key of the chain in a transaction of :meth:`Secrets.write_alone`.

        A line under the old key ends its time, and one under the new key begins the next, with the
        hash of the other in it. Returns the secret, and the new head.
        """
        old = self._key()
        end = self._append(connection, Entry(RENEWAL, "retired", by), old)
        fresh = self._secrets.renew(
            connection, SecretName.CHAIN, at=self._clock(), line=end.sequence
        )
        assert fresh is not None, "its value was read just now"  # noqa: S101
        moved = head_mac(fresh.value, end)
        connection.execute(_MOVE_HEAD, {"sequence": end.sequence, "hash": end.hash, "mac": moved})
        begun = self._append(connection, Entry(RENEWAL, "renewed", by), fresh.value)
        return fresh, begun

    def _append(self, connection: Connection, entry: Entry, key: bytes) -> Anchor:
        last = self._head(connection, key, for_update=True)
        values: dict[str, str | int | bytes | datetime | None] = {
            "sequence": last.sequence + 1,
            "at": self._clock(),
            "tenant": entry.tenant,
            "actor": entry.by.actor,
            "action": entry.action,
            "pseudonym": entry.pseudonym,
            "outcome": entry.outcome,
            "request_id": entry.by.request_id,
            "detail": entry.detail,
            "nonce": entry.nonce,
            "previous_hash": last.hash,
        }
        new = Anchor(last.sequence + 1, line_hash(key, values))
        connection.execute(_ADD_LINE, {**values, "hash": new.hash})
        moved = {"sequence": new.sequence, "hash": new.hash, "mac": head_mac(key, new)}
        connection.execute(_MOVE_HEAD, moved)
        return new

    def record(self, entry: Entry) -> None:
        """Add a line in a transaction of its own."""
        self.prepare()
        self._secrets.write(lambda connection: self.append(connection, entry))

    def head(self) -> Anchor:
        """Number and hash of the last line; keep them elsewhere, to verify the log against.

        Raises
        ------
        BrokenAuditLog
            If the head row is missing or forged.
        """
        self.prepare()
        return self._secrets.read(lambda connection: self._head(connection, self._key()))

    def lines(self, *, after: int = 0, batch: int = BATCH) -> Iterator[Line]:
        """Read the log from the line after `after` on, a batch in memory at a time.

        Raises
        ------
        StoreError
            At a line that was altered so that it cannot be read.
        """
        while rows := self._database.read(partial(read_lines, after=after, batch=batch)):
            yield from (read_line(row._mapping) for row in rows)
            after = rows[-1].sequence

    def page(
        self,
        tenant: str,
        *,
        limit: int,
        before: int | None = None,
        pseudonyms: Sequence[str] = (),
    ) -> tuple[list[tuple[int, Line | None]], int | None]:
        """Read the latest lines of a tenant, the latest first.

        It begins at the line that the head names, and ends after the last erasure of a tenant of
        this name: the lines before are not this tenant's.

        Parameters
        ----------
        tenant
            Whose lines.
        limit
            So many lines at most.
        before
            What the page before returned; None begins at the end of the log.
        pseudonyms
            Only lines on a subject that has one of these.

        Returns
        -------
        The lines by their numbers, None for one that was altered; and the number to go on before,
        None at the beginning of the log. That lines were removed or moved, only :meth:`verify`
        finds. No more than :data:`SCANNED` lines of all tenants are looked through, so a page may
        be short, or empty, and not the last.

        Raises
        ------
        BrokenAuditLog
            If the head row, or the key of the chain, is missing or forged.
        """

        def work(connection: Connection) -> tuple[list[tuple[int, Line | None]], int | None]:
            keys = self.line_keys()
            head = self._head(connection, keys.current).sequence
            end = head + 1 if before is None else min(before, head + 1)
            start = self._last_erasure(connection, tenant, keys, head)
            above = max(start, end - 1 - SCANNED)
            rows = read_tenant_lines(
                connection, tenant, pseudonyms, above=above, before=end, limit=limit + 1
            )
            lines = [(row.sequence, true_line(keys, row._mapping)) for row in rows[:limit]]
            if len(rows) > limit:
                return lines, lines[-1][0]
            return lines, above + 1 if above > start else None

        self.prepare()
        return self._secrets.read(work)

    def _last_erasure(self, connection: Connection, tenant: str, keys: LineKeys, head: int) -> int:
        for row in read_tenant_erasures(connection, tenant, through=head):
            # A made-up one would hide the lines before it.
            if true_line(keys, row._mapping) is not None:
                return int(row.sequence)
        return 0

    def verify(
        self,
        *,
        anchor: Anchor | None = None,
        progress: Callable[[int], None] | None = None,
        batch: int = BATCH,
    ) -> Verification:
        """Walk over the whole chain beside a service in use, a batch in memory at a time.

        Parameters
        ----------
        anchor
            An earlier head. Without one, an old state of the whole log is not told from a new one.
        progress
            Called after each batch with the number of its lines.
        batch
            Lines read at once.

        Raises
        ------
        BrokenAuditLog
            If the key of the chain is gone, so that nothing can be checked.
        SealError
            If the master key is not the one that the log was written with.
        """
        keys = self.line_keys()
        while True:
            verification = self._walk(keys, anchor, progress, batch)
            # Renewed during the walk, the lines after it are under a key that was not known.
            self._secrets.read(self._secrets.follow)
            if keys == (keys := self.line_keys()):
                return verification

    def _walk(
        self,
        keys: LineKeys,
        anchor: Anchor | None,
        progress: Callable[[int], None] | None,
        batch: int,
    ) -> Verification:
        chain = Chain(keys, anchor=anchor)
        after: int | None = None
        while True:
            while rows := self._database.read(partial(read_lines, after=after, batch=batch)):
                for row in rows:
                    chain.step(row._mapping)
                after = rows[-1].sequence
                if progress is not None:
                    progress(len(rows))
            end = self._database.read(partial(read_end, after=after))
            if not end.more:
                return chain.end(end.head, end.mac, held=end.held)

    def _chain(self) -> Secret:
        chain = self._secrets.existing(SecretName.CHAIN)
        if chain is None:
            raise _without_key()
        return chain

    def _key(self) -> bytes:
        return self._chain().value

    def _head(self, connection: Connection, key: bytes, *, for_update: bool = False) -> Anchor:
        head, mac = read_head(connection, for_update=for_update)
        if head is None or not is_head(key, head, mac):
            raise BrokenAuditLog(
                "the head of the audit log is missing or was altered: "
                "run `veilface audit-log verify`, and restore the database from a backup"
            )
        return head

    def __repr__(self) -> str:
        return "AuditLog()"


def _without_key() -> BrokenAuditLog:
    return BrokenAuditLog(
        "the key of the audit log is missing: run `veilface db upgrade` on a new database, and "
        "restore any other from a backup"
    )
