"""Idempotency records: a repeated write with the same key is answered, not done again.

A write first claims its key, then runs, then leaves its answer. A claim that its worker did not
finish (it was killed) lapses after a minute, so that the client's next try may run. Keys and
requests are kept as HMAC-SHA256 under a secret of the deployment: a record does not tell whose
photo was sent to somebody who holds the photo. Answers must hold no biometric data. An answer
carries a MAC: one that somebody else wrote is not given, and the write runs.
"""

import hmac
import uuid
from dataclasses import dataclass, field
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
    """The key was used for another request, or its first request is still running."""


@dataclass(frozen=True)
class Claim:
    """The right to run a write; hand it back by ``finish`` or ``release``."""

    tenant_id: str
    actor: str
    key_hash: bytes = field(repr=False)
    request_hash: bytes = field(repr=False)
    token: str = field(repr=False)
    expires_at: datetime


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
            connection.execute(sa.delete(IdempotencyRow).where(*_is(claim), lapsed))
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
            if row.status is None or row.body is None:
                raise IdempotencyConflict("the first request with this key is still running")
            return Answer(row.status, row.body)

        return context.write(work, lock=f"idempotency {tenant} {actor} {lock}")

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
        )

    def _is_authentic(self, row: Any) -> bool:
        return is_authentic(self._context.audit_log.row_key(), IdempotencyRow, row._mapping)

    def finish(self, claim: Claim, *, status: int, body: bytes) -> bool:
        """Leave the answer; False if the claim is gone (lapsed, or the subject was erased)."""
        if len(body) > MAX_BODY_BYTES:
            raise StoreError(f"an answer of more than {MAX_BODY_BYTES} bytes is not kept")
        row = {**vars(claim), "claim": claim.token, "status": status, "body": body}

        def work(connection: Connection) -> bool:
            mac = row_mac(self._context.audit_log.row_key(), IdempotencyRow, row)
            statement = (
                sa.update(IdempotencyRow)
                .where(*_is(claim), IdempotencyRow.claim == claim.token)
                .values(status=status, body=body, mac=mac)
            )
            return connection.execute(statement).rowcount == 1

        return self._context.write(work)

    def release(self, claim: Claim) -> None:
        """Give the key back, because the write failed and may be tried again."""
        statement = sa.delete(IdempotencyRow).where(
            *_is(claim), IdempotencyRow.claim == claim.token, IdempotencyRow.status.is_(None)
        )
        self._context.database.write(lambda connection: connection.execute(statement))

    def expire(self) -> int:
        """Remove records that are older than a day; returns how many."""
        expired = IdempotencyRow.expires_at <= self._context.clock()
        return self._context.database.remove(IdempotencyRow, expired, batch=BATCH)


_RECORD: Any = sa.select(*columns_of(IdempotencyRow))


def _is(claim: Claim) -> tuple[sa.ColumnElement[bool], ...]:
    return (
        IdempotencyRow.tenant_id == claim.tenant_id,
        IdempotencyRow.actor == claim.actor,
        IdempotencyRow.key_hash == claim.key_hash,
    )
