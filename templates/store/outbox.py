"""Events that the operator's endpoint is to be told, kept until it has taken them.

An event is written in the transaction of what it tells: neither is there without the other. A
worker claims the oldest event that is due, for a while, sends it, and removes it when the endpoint
has taken it. A worker that dies leaves the claim to lapse, and another one sends again: at least
once. An event waits for the earlier ones of its subject.

Who reads the database learns no subject id: the body is sealed under the master key, and its
subject named by a pseudonym. Who writes it makes no event: each row carries a MAC of the deployment
(``templates.store.authenticity``), and what has none is dropped. An old row can be put back, and is
sent again until it is older than :data:`KEPT`.
"""

import uuid
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.orm import aliased

from templates.contract.canonical import Json, canonical_json
from templates.errors import SealError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.audit_log import AuditLog
from templates.store.authenticity import columns_of, is_authentic, row_mac, warn
from templates.store.database import Database
from templates.store.deployment import Secrets
from templates.store.identifiers import Clock
from templates.store.schema import OutboxRow

LEASE = timedelta(minutes=1)
FIRST_WAIT = timedelta(seconds=2)
LONGEST_WAIT = timedelta(hours=1)
RETRIED = timedelta(days=3)
"""Age of an event from which a failed attempt is the last one."""
KEPT = timedelta(days=7)
"""Age of an event from which it is not sent any more, tried or not."""
BODY_PURPOSE = "webhook-event"
BATCH = 500
_LOCK = "webhook outbox"
_MOST_ATTEMPTS = 1_000_000  # of a count, which somebody else may have written


class EventType(StrEnum):
    """What is told."""

    ENROLLED = "subject.enrolled"
    ERASED = "subject.erased"
    LOCKED_OUT = "subject.locked_out"


@dataclass(frozen=True)
class Event:
    """A claimed event.

    Attributes
    ----------
    event_id
        Stays the same in every attempt.
    body
        Its JSON.
    attempts
        How often it was claimed, this time included.
    created_at
        When what it tells happened.
    """

    event_id: str
    body: str = field(repr=False)
    attempts: int
    created_at: datetime


class Outbox:
    """Repository of events.

    Parameters
    ----------
    database, keyring, secrets, audit_log, clock
        Of the deployment.
    tells
        Whether events are written; what is there is kept and removed either way.
    """

    def __init__(
        self,
        database: Database,
        keyring: MasterKeyring,
        secrets: Secrets,
        audit_log: AuditLog,
        clock: Clock,
        *,
        tells: bool,
    ) -> None:
        self._database = database
        self._keyring = keyring
        self._secrets = secrets
        self._audit_log = audit_log
        self._clock = clock
        self._tells = tells

    def add(
        self,
        connection: Connection,
        event_type: EventType,
        *,
        tenant_id: str,
        tenant: str,
        pseudonym: str,
        subject_id: str,
        **data: Json,
    ) -> None:
        """Write an event, in the transaction of what it tells and under the subject's lock."""
        if not self._tells:
            return
        now, event_id = self._clock(), uuid.uuid4().hex
        body = canonical_json(
            {
                "type": event_type.value,
                "timestamp": now.isoformat(),
                "data": {"tenant": tenant, "subject_id": subject_id, **data},
            }
        )
        sealed = self._keyring.seal(body, purpose=BODY_PURPOSE, bound_to=[event_id])
        row = {
            "event_id": event_id,
            "tenant_id": tenant_id,
            "pseudonym": pseudonym,
            "wrapped_body": sealed,
            "wrapping_key": sealed_key_id(sealed),
            "attempts": 0,
            "created_at": now,
            "due_at": now,
        }
        mac = row_mac(self._audit_log.row_key(), OutboxRow, row)
        connection.execute(sa.insert(OutboxRow).values(**row, mac=mac))

    def claim(self) -> Event | None:
        """Claim the oldest event that is due, for :data:`LEASE`; None where there is none.

        A row that nobody of this deployment wrote, or that is too old, is removed; one whose master
        key is missing here is left to other workers.
        """
        now = self._clock()
        # Read first: most rounds find nothing, and take no lock.
        if self._database.read(lambda each: each.execute(_due(now)).first()) is None:
            return None

        # Locked, because another worker may be removing it.
        next_due = _due(now).with_for_update()

        def work(connection: Connection) -> Event | None:
            while (sequence := connection.execute(next_due).scalar()) is not None:
                event = self._read(connection, sequence)
                this = OutboxRow.sequence == sequence
                if event is None or event.created_at <= now - KEPT:
                    connection.execute(sa.delete(OutboxRow).where(this))
                    continue
                claimed = {"due_at": now + LEASE, "attempts": event.attempts}
                connection.execute(sa.update(OutboxRow).where(this).values(claimed))
                if event.body:
                    return event
            return None

        self._audit_log.prepare()
        return self._secrets.write(work, lock=_LOCK)

    def _read(self, connection: Connection, sequence: int) -> Event | None:
        """Read an event; None where it is not authentic, an empty body where its key is missing."""
        try:
            row: Any = connection.execute(_ROW, {"sequence": sequence}).one()
            if not is_authentic(self._audit_log.row_key(), OutboxRow, row._mapping):
                raise ValueError
            attempts = min(row.attempts + 1, _MOST_ATTEMPTS)
            return Event(row.event_id, self._body(row), attempts, row.created_at)
        except (ValueError, TypeError, SealError):
            # SQLite keeps any value in any column.
            warn("a webhook event in the database is not authentic and was dropped")
            return None

    def _body(self, row: Any) -> str:
        try:
            sealed, bound_to = row.wrapped_body, [row.event_id]
            return self._keyring.open(sealed, purpose=BODY_PURPOSE, bound_to=bound_to).decode()
        except SealError:
            if sealed_key_id(sealed) in self._keyring.key_ids:
                raise
            warn("the master key of a webhook event is missing: put it back as a further line")
            return ""

    def taken(self, event: Event) -> None:
        """Remove an event that the endpoint has taken."""
        self._database.write(lambda connection: _remove(connection, event))

    def postpone(self, event: Event) -> None:
        """Let an event wait that the endpoint did not take: twice as long each time.

        One that is older than :data:`RETRIED` is given up.
        """
        now = self._clock()
        if event.created_at <= now - RETRIED:
            warn("a webhook event was not taken for days, and is given up")
            self.taken(event)
            return
        wait = min(LONGEST_WAIT, FIRST_WAIT * 2 ** max(0, min(event.attempts - 1, 16)))
        statement = (
            sa.update(OutboxRow)
            .where(OutboxRow.event_id == event.event_id, OutboxRow.attempts == event.attempts)
            .values(due_at=now + wait)
        )
        self._database.write(lambda connection: connection.execute(statement))

    def expire(self) -> int:
        """Remove events that are older than :data:`KEPT`, told or not; returns how many."""
        too_old = OutboxRow.created_at <= self._clock() - KEPT
        return self._database.remove(OutboxRow, too_old, batch=BATCH)

    def waiting(self) -> int:
        """Count the events that were not taken yet."""
        query = sa.select(sa.func.count()).select_from(OutboxRow)
        return int(self._database.read(lambda each: each.execute(query).scalar_one()))


def _due(now: datetime) -> Any:
    earlier = aliased(OutboxRow)
    waits = sa.exists().where(
        earlier.tenant_id == OutboxRow.tenant_id,
        earlier.pseudonym == OutboxRow.pseudonym,
        earlier.sequence < OutboxRow.sequence,
    )
    return (
        sa.select(OutboxRow.sequence)
        .where(OutboxRow.due_at <= now, ~waits)
        .order_by(OutboxRow.due_at)
        .limit(1)
    )


_ROW: Any = sa.select(*columns_of(OutboxRow), OutboxRow.wrapped_body, OutboxRow.attempts).where(
    OutboxRow.sequence == sa.bindparam("sequence")
)


def _remove(connection: Connection, event: Event) -> None:
    # Not by its number, which SQLite may give to a later event.
    connection.execute(sa.delete(OutboxRow).where(OutboxRow.event_id == event.event_id))
