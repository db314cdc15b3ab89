"""Idempotency records: a repeated write with the same key is answered, not done again.

A write first claims its key, then runs, and leaves its answer in its own transaction: a worker that
is killed has done both or neither. A claim that was not finished lapses after a minute, so that the
client's next try may run. An answer that holds a template for its holder is not kept; the record
then says what was written, so that the next try may replace that, whatever its precondition. Keys
and requests are kept as HMAC-SHA256 under a secret of the deployment: a record does not tell whose
photo was sent to somebody who holds the photo. Answers must hold no biometric data. An answer
carries a MAC: one that somebody else wrote is not given, and the write runs.
"""

import hmac
import uuid
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import encode_parts
from templates.store.authenticity import columns_of, is_authentic, row_mac, warn
from templates.store.context import StoreContext
from templates.store.deployment import insert_once
from templates.store.schema import IdempotencyRow
from templates.store.secret import SecretName
from templates.store.subject_rows import tenant_id_of

RETENTION = timedelta(hours=24)
CLAIM = timedelta(minutes=1)
BATCH = 500
MAX_KEY = 255
MAX_BODY_BYTES = 64 * 1024


class IdempotencyConflict(StoreError):
    """The key is another request's, its first still runs, or this one was given up meanwhile."""


@dataclass(frozen=True)
class Claim:
    """The right to run a write, which ends with ``finish`` or ``release``.

    `written` is the template that an earlier run of the same request has written, whose answer was
    not kept.
    """

    tenant_id: str
    actor: str
    key_hash: bytes = field(repr=False)
    request_hash: bytes = field(repr=False)
    token: str = field(repr=False)
    expires_at: datetime
    written: str | None = None


@dataclass(frozen=True)
class Answer:
    """What the first run of the write answered."""

    status: int
    body: bytes = field(repr=False)


class Idempotency:
    """Repository of idempotency records."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def claim(
        self, tenant: str, *, actor: str, key: str, request: bytes, subject_id: str | None = None
    ) -> Claim | Answer:
        """Claim a key for a write, or return what the write answered before.

        Parameters
        ----------
        tenant, actor
            Whose key it is; `actor` is the prefix of the API key.
        key
            The client's ``Idempotency-Key``, 1 to 255 characters.
        request
            Whatever makes the request the same (method, path, digest of the body).
        subject_id
            The subject that the write concerns; erasing it removes the record.

        Raises
        ------
        IdempotencyConflict
            If the key belongs to another request, or to one that is still running.
        """
        if not 1 <= len(key) <= MAX_KEY:
            raise StoreError(f"an idempotency key has 1 to {MAX_KEY} characters")
        context = self._context
        # Obtained before the transaction needs it.
        lock = context.secrets.get(SecretName.IDEMPOTENCY).digest(encode_parts("key", key)).hex()

        def work(connection: Connection) -> Claim | Answer:
            secret = context.secrets.get(SecretName.IDEMPOTENCY)
            key_hash = secret.digest(encode_parts("key", key))
            request_hash = secret.digest(encode_parts("request", request))
            pseudonym = None if subject_id is None else context.signer.pseudonym(tenant, subject_id)
            tenant_id = tenant_id_of(connection, tenant)
            now = context.clock()
            claim = Claim(
                tenant_id, actor, key_hash, request_hash, uuid.uuid4().hex, now + RETENTION
            )
            lapsed = sa.or_(
                IdempotencyRow.expires_at <= now,
                sa.and_(IdempotencyRow.status.is_(None), IdempotencyRow.claimed_until <= now),
            )
            # Of the very row that goes: a run that stood still may leave its note meanwhile.
            gone = sa.delete(IdempotencyRow).where(*_is(claim), lapsed).returning(*_COLUMNS)
            claim = replace(
                claim, written=self._written(connection.execute(gone).one_or_none(), claim)
            )
            if self._insert(connection, claim, pseudonym, now):
                return claim
            row = connection.execute(_RECORD.where(*_is(claim))).one()
            if row.status is not None and not self._is_authentic(row):
                warn("an idempotency record is not authentic and was passed over", tenant=tenant)
                connection.execute(sa.delete(IdempotencyRow).where(*_is(claim)))
                self._insert(connection, claim, pseudonym, now)
                return claim
            if not hmac.compare_digest(row.request_hash, request_hash):
                raise IdempotencyConflict("this idempotency key was used for another request")
            if row.status is None:
                raise IdempotencyConflict("the first request with this key is still running")
            return Answer(row.status, row.body or b"")

        return context.write(work, lock=f"idempotency {tenant} {actor} {lock}")

    def _written(self, row: Any, claim: Claim) -> str | None:
        """Return what an earlier run of the request wrote whose answer was not kept."""
        if row is None or row.status is not None or row.body is None:
            return None
        same = hmac.compare_digest(row.request_hash, claim.request_hash)
        return row.body.decode() if same and self._is_authentic(row) else None

    def _insert(
        self, connection: Connection, claim: Claim, pseudonym: str | None, now: datetime
    ) -> bool:
        return insert_once(
            connection,
            IdempotencyRow,
            tenant_id=claim.tenant_id,
            actor=claim.actor,
            key_hash=claim.key_hash,
            request_hash=claim.request_hash,
            pseudonym=pseudonym,
            claim=claim.token,
            claimed_until=now + CLAIM,
            created_at=now,
            expires_at=claim.expires_at,
            **({} if claim.written is None else self._noted(claim, None, claim.written.encode())),
        )

    def _noted(self, claim: Claim, status: int | None, body: bytes) -> dict[str, Any]:
        """Columns of a record that holds something, with their MAC."""
        noted: dict[str, Any] = {"status": status, "body": body}
        row = {**vars(claim), "claim": claim.token, **noted}
        noted["mac"] = row_mac(self._context.audit_log.row_key(), IdempotencyRow, row)
        return noted

    def _is_authentic(self, row: Any) -> bool:
        return is_authentic(self._context.audit_log.row_key(), IdempotencyRow, row._mapping)

    def finish(self, connection: Connection, claim: Claim, answer: Answer) -> None:
        """Leave the answer, in the transaction of the write.

        Raises
        ------
        IdempotencyConflict
            If the record is not the claim's any more, so that the answer would be left nowhere: the
            claim lapsed, and another run of the request has or had it, or the subject was erased.
            The write is taken back.
        """
        if len(answer.body) > MAX_BODY_BYTES:
            raise StoreError(f"an answer of more than {MAX_BODY_BYTES} bytes is not kept")
        self._leave(connection, claim, answer.status, answer.body)

    def note_written(self, connection: Connection, claim: Claim, template_id: str) -> None:
        """Leave what was written in place of an answer that must not be kept; see ``finish``.

        The next run of the same request may begin at once.
        """
        until = self._context.clock()
        self._leave(connection, claim, None, template_id.encode(), claimed_until=until)

    def _leave(
        self, connection: Connection, claim: Claim, status: int | None, body: bytes, **more: Any
    ) -> None:
        def is_left(ours: Claim) -> bool:
            record = sa.update(IdempotencyRow).where(*_is(ours), IdempotencyRow.claim == ours.token)
            noted = self._noted(ours, status, body)
            return connection.execute(record.values(**noted, **more)).rowcount == 1

        if is_left(claim):
            return
        # A renewal of the secrets makes other hashes of key and request, and leaves the token.
        row = connection.execute(
            _RECORD.where(
                IdempotencyRow.tenant_id == claim.tenant_id,
                IdempotencyRow.actor == claim.actor,
                IdempotencyRow.claim == claim.token,
            )
        ).one_or_none()
        if row is not None and is_left(
            replace(claim, key_hash=row.key_hash, request_hash=row.request_hash)
        ):
            return
        raise IdempotencyConflict(
            "another run of this request has taken over, or its subject was erased meanwhile"
        )

    def release(self, claim: Claim) -> None:
        """Give the key back, because the write failed and may be tried again.

        An answer stays, and so does a note: the commit may have gone through though its news did
        not.
        """
        unanswered = sa.and_(
            *_is(claim), IdempotencyRow.claim == claim.token, IdempotencyRow.status.is_(None)
        )
        noted = IdempotencyRow.body.is_not(None)

        def work(connection: Connection) -> None:
            now = self._context.clock()
            connection.execute(sa.delete(IdempotencyRow).where(unanswered, ~noted))
            connection.execute(
                sa.update(IdempotencyRow).where(unanswered, noted).values(claimed_until=now)
            )

        self._context.database.write(work)

    def expire(self) -> int:
        """Remove records that are older than a day; returns how many."""
        expired = IdempotencyRow.expires_at <= self._context.clock()
        return self._context.database.remove(IdempotencyRow, expired, batch=BATCH)


_COLUMNS = columns_of(IdempotencyRow)
_RECORD: Any = sa.select(*_COLUMNS)


def _is(claim: Claim) -> tuple[sa.ColumnElement[bool], ...]:
    return (
        IdempotencyRow.tenant_id == claim.tenant_id,
        IdempotencyRow.actor == claim.actor,
        IdempotencyRow.key_hash == claim.key_hash,
    )
