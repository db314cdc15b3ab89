"""Failed attempts on a subject, the lock that follows them, and probes that were seen before.

Counts belong to the subject, never to an API key, and to a subject that is not enrolled just as to
one that is: neither a second key nor the lock itself tells more, or allows more. They live in the
database only, so that every worker counts the same and a restart forgets nothing. What is counted
is held against the audit log (``templates.store.standing``), and so is a nonce: removing either
from its table changes nothing.
"""

import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring, encode_parts
from templates.store.attempt_queries import BEFORE, FIRST_COUNTS, NEXT_COUNTS, NOTE_USE, STANDING
from templates.store.audit_log import AuditLog, By, Entry
from templates.store.database import Database
from templates.store.deployment import insert_once
from templates.store.identifiers import Clock, UnknownTenant, checked_subject_id
from templates.store.lockout import LockedOut, LockoutPolicy, Nonce, Replayed, Superseded
from templates.store.receipts import ReceiptSigner
from templates.store.schema import FailedAttemptsRow, UsedNonceRow
from templates.store.standing import (
    UNKNOWN_RETENTION,
    AttemptsStatus,
    Subject,
    counts_row,
    standing,
)
from templates.store.subjects import (
    TEMPLATE_COLUMNS,
    SubjectTemplate,
    opened_template,
    subject_lock,
)

NONCE_GRACE = timedelta(minutes=5)
BATCH = 500


@dataclass(frozen=True)
class Attempt:
    """What a probe is to be decided by.

    Attributes
    ----------
    rotation_epoch
        The tenant's current one.
    template
        The subject's; None where there is none of the contract.
    """

    rotation_epoch: int
    template: SubjectTemplate | None

    @property
    def template_id(self) -> str | None:
        """Id of the template."""
        return None if self.template is None else self.template.record.template_id


class Decided(Protocol):
    """A decision, as far as it is recorded."""

    @property
    def accepted(self) -> bool:
        """Whether the subject is accepted; never where it has no template."""
        ...

    @property
    def level(self) -> str:
        """Security level."""
        ...


D = TypeVar("D", bound=Decided)


class Attempts:
    """Repository of failed attempts and used nonces."""

    def __init__(
        self,
        database: Database,
        keyring: MasterKeyring,
        signer: ReceiptSigner,
        audit_log: AuditLog,
        clock: Clock,
        policy: LockoutPolicy,
    ) -> None:
        self._database = database
        self._keyring = keyring
        self._signer = signer
        self._audit_log = audit_log
        self._clock = clock
        self._policy = policy

    def begin(
        self, tenant: str, subject_id: str, *, contract_id: str, nonce: Nonce | None = None
    ) -> Attempt:
        """Read all that a decision needs, and refuse early what :meth:`conclude` would refuse.

        One query, whether the subject is enrolled or not; nothing is written. It saves the work of
        a decision, and decides nothing itself: others may fail meanwhile.

        Parameters
        ----------
        tenant, subject_id
            Whom the probe is to be compared with.
        contract_id
            A template of another contract is as good as none: nothing of it is read or decrypted,
            so that it costs what a subject costs that does not exist.
        nonce
            Of a signed probe; None for a photo.

        Raises
        ------
        LockedOut, Replayed, UnknownTenant
        SealError
            If the row was altered or moved, or its master key is missing.
        """
        about = self._about(tenant, subject_id, nonce, contract_id)
        return self._opened(self._database.read(partial(self._before, about=about)))

    def conclude(
        self,
        tenant: str,
        subject_id: str,
        *,
        accepted: bool,
        template_id: str | None,
        contract_id: str | None = None,
        level: str,
        nonce: Nonce | None,
        by: By,
    ) -> None:
        """Count a decision, in one transaction, before anybody is told of it.

        The nonce is used up. Where the subject is locked by now, the decision is withheld: however
        many probes were sent at once, at most `after` of their rejections are let out before the
        lock, and an accept that comes too late is not let out either. Else a failure is counted, or
        an accept clears the count and notes the use of the enrollment. The audit log gets its
        line in every case, that of a refusal too. Only a decision on a template that was replaced
        or erased since is no decision: it is taken back whole, and made again by the caller.

        Parameters
        ----------
        tenant, subject_id
            Whom the probe was compared with.
        accepted
            The decision; who is not enrolled is never accepted.
        template_id
            Id of the template that was decided on; None for a subject that was not enrolled.
        contract_id
            As of :meth:`begin`; None where any template counts.
        level
            Security level of the decision, for the audit log.
        nonce
            Of a signed probe; None for a photo.
        by
            Who asked.

        Raises
        ------
        Replayed
            If the nonce was used before.
        LockedOut
            If the subject is locked now.
        Superseded
            If the subject's template is another one now. Nothing is written.
        UnknownTenant, StoreError, StoreUnavailable
        """
        about = self._about(tenant, subject_id, nonce, contract_id)
        self._audit_log.prepare()

        def work(connection: Connection) -> LockedOut | Replayed | None:
            return self._record(connection, about, accepted, template_id, nonce, level, by)

        refusal = self._database.write(work, lock=subject_lock(tenant, subject_id))
        if refusal is not None:
            raise refusal

    def decide_alone(
        self,
        tenant: str,
        subject_id: str,
        decide: Callable[[Attempt], D],
        *,
        contract_id: str,
        nonce: Nonce | None,
        by: By,
    ) -> D:
        """:meth:`begin`, a decision and :meth:`conclude` while nobody replaces the template.

        Enrollments and erasures of the subject, on SQLite all writes, wait until `decide` has
        returned: for a subject that is replaced again and again while a probe is compared. What
        `decide` raises is raised, and then nothing is written. Only a renewal of the tenant's
        rotation does not wait, so `decide` may still find that it was retired.

        Raises
        ------
        LockedOut, Replayed, UnknownTenant, SealError, StoreError, StoreUnavailable
        """
        about = self._about(tenant, subject_id, nonce, contract_id)
        self._audit_log.prepare()

        def work(connection: Connection) -> D | LockedOut | Replayed:
            attempt = self._opened(self._before(connection, about))
            decided = decide(attempt)
            refusal = self._record(
                connection, about, decided.accepted, attempt.template_id, nonce, decided.level, by
            )
            return decided if refusal is None else refusal

        found = self._database.write(work, lock=subject_lock(tenant, subject_id))
        if isinstance(found, LockedOut | Replayed):
            raise found
        return found

    def reset(self, tenant: str, subject_id: str, *, by: By) -> bool:
        """Forget the consecutive failures on a subject, its lock and its being disabled.

        Returns
        -------
        bool
            False if there was none of these. The total stays.
        """
        about = self._about(tenant, subject_id)

        def work(connection: Connection) -> bool:
            row = _one(connection, query=STANDING, about=about)
            status = self._standing(connection, row, about)
            lifted = status is not None and status.holds_something
            outcome = "reset" if lifted else "nothing_held"
            entry = Entry("lockout-reset", outcome, by, tenant, about["pseudonym"])
            line = self._audit_log.append(connection, entry)
            if lifted and status is not None:
                self._write_counts(connection, row, about, status.cleared(), line)
            return lifted

        return self._database.write(work, lock=subject_lock(tenant, subject_id))

    def status(self, tenant: str, subject_id: str) -> AttemptsStatus | None:
        """What is counted of a subject; None if no attempt on it ever failed."""
        about = self._about(tenant, subject_id)

        def work(connection: Connection) -> AttemptsStatus | None:
            row = connection.execute(STANDING, about).one_or_none()
            return None if row is None else self._standing(connection, row, about)

        return self._database.read(work)

    def expire(self) -> int:
        """Remove nonces that are past their time, and old counts of who is not enrolled.

        A nonce is kept for five minutes more, for requests that run and clocks that differ. A count
        goes ninety days after the last failure, unless the subject is disabled; that of an enrolled
        subject goes with the subject. In small transactions, so that after a long pause no write
        waits for all of it.

        Returns
        -------
        int
            How many were removed.
        """
        now = self._clock()
        return self._database.remove(
            UsedNonceRow, UsedNonceRow.expires_at <= now - NONCE_GRACE, batch=BATCH
        ) + self._database.remove(
            FailedAttemptsRow,
            sa.and_(
                FailedAttemptsRow.known.is_(False),
                FailedAttemptsRow.disabled_at.is_(None),
                FailedAttemptsRow.last_failed_at <= now - UNKNOWN_RETENTION,
            ),
            batch=BATCH,
        )

    def _about(
        self,
        tenant: str,
        subject_id: str,
        nonce: Nonce | None = None,
        contract_id: str | None = None,
    ) -> dict[str, Any]:
        self._audit_log.prepare()
        return {
            "tenant": tenant,
            "subject_id": subject_id,
            "pseudonym": self._signer.pseudonym(tenant, checked_subject_id(subject_id)),
            "contract_id": contract_id,
            "key_prefix": None if nonce is None else nonce.key_prefix,
            "nonce_hash": None if nonce is None else nonce.hash,
            "nonce_digest": None if nonce is None else self._digest(nonce),
        }

    def _digest(self, nonce: Nonce) -> str:
        """What the audit log keeps of a nonce."""
        message = encode_parts("nonce", nonce.key_prefix, nonce.hash)
        return hmac.new(self._audit_log.row_key(), message, hashlib.sha256).hexdigest()

    def _before(self, connection: Connection, about: dict[str, Any]) -> Any:
        """Row of :data:`BEFORE`, where nothing refuses the attempt."""
        row = _one(connection, query=BEFORE, about=about)
        if row.used:
            raise Replayed
        self._refuse_locked(self._standing(connection, row, about), self._clock())
        return row

    def _opened(self, row: Any) -> Attempt:
        template = row[: len(TEMPLATE_COLUMNS)]
        found = None if row.template_id is None else opened_template(template, self._keyring)
        return Attempt(rotation_epoch=row.current_epoch, template=found)

    def _standing(
        self, connection: Connection, row: Any, about: dict[str, Any]
    ) -> AttemptsStatus | None:
        return standing(
            connection,
            row,
            Subject(about["tenant"], about["pseudonym"]),
            line_key=self._audit_log.line_key(),
            row_key=self._audit_log.row_key(),
            policy=self._policy,
            now=self._clock(),
        )

    def _record(
        self,
        connection: Connection,
        about: dict[str, Any],
        accepted: bool,
        template_id: str | None,
        nonce: Nonce | None,
        level: str,
        by: By,
    ) -> LockedOut | Replayed | None:
        row = _one(connection, query=STANDING, about=about)
        status = self._standing(connection, row, about)
        contract_id = about["contract_id"]
        if accepted and template_id is None:
            raise ValueError("a subject that is not enrolled cannot be accepted")
        outcome = "accept" if accepted else "reject"
        refusal: LockedOut | Replayed | None = None
        counted: AttemptsStatus | None = None
        try:
            _use(connection, nonce, row)
            now = self._clock()
            self._refuse_locked(status, now)
            of_contract = contract_id in (None, row.contract_id)
            if (row.template_id if of_contract else None) != template_id:
                raise Superseded
            if accepted:
                counted = status.cleared() if status and status.holds_something else None
                note = {"of_subject": row.subject_pk, "last_used_at": now}
                connection.execute(NOTE_USE, note)
            else:
                counted = self._failed(status, now)
        except LockedOut as error:
            outcome, refusal = "locked_out", LockedOut(error.retry_after_s, recorded=True)
        except Replayed:
            outcome, refusal = "replayed", Replayed(recorded=True)
        entry = Entry(
            "verify",
            outcome,
            by,
            about["tenant"],
            about["pseudonym"],
            detail=level,
            nonce=None if outcome == "replayed" else about["nonce_digest"],
        )
        line = self._audit_log.append(connection, entry)
        if counted is not None:
            self._write_counts(connection, row, about, counted, line)
        return refusal

    def _refuse_locked(self, status: AttemptsStatus | None, now: datetime) -> None:
        if not self._policy.after or status is None:
            return
        if status.disabled_at is not None:
            raise LockedOut(None)
        if status.locked_until is not None and now < status.locked_until:
            raise LockedOut((status.locked_until - now).total_seconds())

    def _failed(self, status: AttemptsStatus | None, now: datetime) -> AttemptsStatus:
        consecutive = 1 if status is None else status.consecutive + 1
        lock = self._policy.lock(consecutive)
        return AttemptsStatus(
            consecutive=consecutive,
            total=1 if status is None else status.total + 1,
            last_failed_at=now,
            locked_until=None if lock is None else now + lock,
            disabled_at=now if self._policy.disables(consecutive) else None,
        )

    def _write_counts(
        self,
        connection: Connection,
        row: Any,
        about: dict[str, Any],
        status: AttemptsStatus,
        line: int,
    ) -> None:
        """Write the row of the subject's failures; only its holder of the lock does."""
        values = counts_row(
            self._audit_log.row_key(), row.tenant_id, about["pseudonym"], status, line
        )
        # As the transaction finds it: an erasure since the decision must not leave a count that
        # only another erasure would remove.
        values["known"] = row.subject_pk is not None
        if row.counted_pseudonym is None:
            connection.execute(FIRST_COUNTS, values)
            return
        whose = {"of_tenant": values.pop("tenant_id"), "of_pseudonym": values.pop("pseudonym")}
        connection.execute(NEXT_COUNTS, {**whose, **values})


def _one(connection: Connection, *, query: Any, about: dict[str, Any]) -> Any:
    try:
        row = connection.execute(query, about).one_or_none()
    except (ValueError, TypeError):
        # SQLite keeps any value in any column.
        raise StoreError(
            "a row about this subject was altered: run `veilface audit-log verify`"
        ) from None
    if row is None:
        raise UnknownTenant(f"there is no tenant {about['tenant']!r}")
    return row


def _use(connection: Connection, nonce: Nonce | None, row: Any) -> None:
    if nonce is None:
        return
    if row.api_key_id is None:
        raise StoreError("there is no API key of this prefix")
    if row.used or not insert_once(
        connection,
        UsedNonceRow,
        api_key_id=row.api_key_id,
        nonce_hash=nonce.hash,
        expires_at=nonce.expires_at,
    ):
        raise Replayed
