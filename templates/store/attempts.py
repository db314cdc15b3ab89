"""Failed attempts on a subject, the lock that follows them, and probes that were seen before.

Counts belong to the subject, never to an API key, and to a subject that is not enrolled just as to
one that is: neither a second key nor the lock itself tells more, or allows more. They live in the
database only, so that every worker counts the same and a restart forgets nothing. What is counted
is held against the audit log (``templates.store.standing``), and so is a nonce: removing either
from its table changes nothing.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.attempt_queries import NOTE_USE, before, named, standing
from templates.store.audit_log import By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import UnknownTenant, checked_subject_id
from templates.store.lockout import LockedOut, LockoutPolicy, Nonce, Replayed, Superseded
from templates.store.nonces import Nonces, spend
from templates.store.schema import FailedAttemptsRow, UsedNonceRow
from templates.store.standing import UNKNOWN_RETENTION, AttemptsStatus, Standing
from templates.store.subject_rows import (
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
    template_id
        Id of the subject's template; None where there is none of the contract.
    template
        That template.
    """

    rotation_epoch: int
    template_id: str | None
    template: SubjectTemplate | None


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
        context: StoreContext,
        nonces: Nonces,
        policy: LockoutPolicy,
    ) -> None:
        self._context = context
        self._nonces = nonces
        self._standing = Standing(context, policy)

    def begin(
        self,
        tenant: str,
        subject_id: str,
        *,
        contract_id: str,
        nonce: Nonce | None = None,
    ) -> Attempt:
        """Read all that a decision needs, and refuse early what :meth:`conclude` would refuse.

        One query, and as many bytes, whether the subject is enrolled or not; nothing is written. It
        saves the work of a decision, and decides nothing itself: others may fail meanwhile.

        Parameters
        ----------
        tenant, subject_id
            Whom the probe is to be compared with.
        contract_id
            A template of another contract is as good as none: nothing of it is read or decrypted,
            so that it costs what a subject costs that does not exist.
        nonce
            Of a challenge or a token; None where there is neither.

        Raises
        ------
        LockedOut, Replayed, UnknownTenant
        SealError
            If the row was altered or moved, or its master key is missing.
        """
        asked = partial(self._asked, tenant, subject_id, nonce, contract_id)
        row = self._context.read(lambda connection: self._before(connection, asked()))
        return self._opened(row)

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
            Id of the template that was decided on; None for a
            subject that was not enrolled.
        contract_id
            As of :meth:`begin`; None where any template counts.
        level
            Security level of the decision, for the audit log.
        nonce
            Of a challenge or a token; None where there is neither.
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

        def work(connection: Connection) -> LockedOut | Replayed | None:
            asked = self._asked(tenant, subject_id, nonce, contract_id)
            return self._record(connection, asked, accepted, template_id, nonce, level, by)

        refusal = self._context.write(work, lock=subject_lock(tenant, subject_id))
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
        LockedOut, Replayed, UnknownTenant, SealError, StoreError,
        StoreUnavailable
        """

        def work(connection: Connection) -> D | LockedOut | Replayed:
            asked = self._asked(tenant, subject_id, nonce, contract_id)
            attempt = self._opened(self._before(connection, asked))
            decided = decide(attempt)
            refusal = self._record(
                connection, asked, decided.accepted, attempt.template_id, nonce, decided.level, by
            )
            return decided if refusal is None else refusal

        outcome = self._context.write(work, lock=subject_lock(tenant, subject_id))
        if isinstance(outcome, LockedOut | Replayed):
            raise outcome
        return outcome

    def reset(self, tenant: str, subject_id: str, *, by: By) -> bool:
        """Forget the consecutive failures on a subject, its lock and its being disabled.

        Returns
        -------
        bool
            False if there was none of these. The total stays.
        """

        def work(connection: Connection) -> bool:
            asked = self._asked(tenant, subject_id)
            row = _one(connection, standing, asked)
            status = self._status(connection, row, asked)
            to_clear = status is not None and status.holds_something
            outcome = "reset" if to_clear else "nothing_held"
            entry = Entry("lockout-reset", outcome, by, tenant, asked["pseudonym"])
            line = self._context.audit_log.append(connection, entry)
            if status is not None and to_clear:
                cleared = status.cleared()
                self._standing.write(connection, row, asked["pseudonym"], cleared, line)
            return to_clear

        return self._context.write(work, lock=subject_lock(tenant, subject_id))

    def status(self, tenant: str, subject_id: str) -> AttemptsStatus | None:
        """What is counted of a subject; None if no attempt on it ever failed."""

        def work(connection: Connection) -> AttemptsStatus | None:
            asked = self._asked(tenant, subject_id)
            row = connection.execute(standing(len(asked["pseudonyms"])), asked).one_or_none()
            return None if row is None else self._status(connection, row, asked)

        return self._context.read(work)

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
        database, now = self._context.database, self._context.clock()
        nonces = UsedNonceRow.expires_at <= now - NONCE_GRACE
        counts = sa.and_(
            FailedAttemptsRow.known.is_(False),
            FailedAttemptsRow.disabled_at.is_(None),
            FailedAttemptsRow.last_failed_at <= now - UNKNOWN_RETENTION,
        )
        removed = database.remove(UsedNonceRow, nonces, batch=BATCH)
        return removed + database.remove(FailedAttemptsRow, counts, batch=BATCH)

    def _asked(
        self,
        tenant: str,
        subject_id: str,
        nonce: Nonce | None = None,
        contract_id: str | None = None,
    ) -> dict[str, Any]:
        """Parameters of :func:`before` and :func:`standing`, and ``pseudonyms``.

        Made in the transaction that asks: a renewal of the secrets changes them.
        """
        pseudonyms = self._context.signer.pseudonyms(tenant, checked_subject_id(subject_id))
        return {
            "tenant": tenant,
            "subject_id": subject_id,
            "pseudonyms": pseudonyms,
            **named(pseudonyms),
            "place": pseudonyms[0][:32],
            "contract_id": contract_id,
            "key_prefix": None if nonce is None else nonce.key_prefix,
            "nonce_hash": None if nonce is None else nonce.hash,
            "nonce_digest": None if nonce is None else self._nonces.digest(nonce),
        }

    def _before(self, connection: Connection, asked: dict[str, Any]) -> Any:
        """Row of :func:`before`, where nothing refuses the attempt."""
        row = _one(connection, before, asked)
        if row.used:
            raise Replayed
        self._standing.refuse_locked(self._status(connection, row, asked))
        return row

    def _opened(self, row: Any) -> Attempt:
        enrolled = row.template_id is not None
        return Attempt(
            rotation_epoch=row.current_epoch,
            template_id=row.template_id,
            template=opened_template(row, self._context.keyring) if enrolled else None,
        )

    def _status(
        self, connection: Connection, row: Any, asked: dict[str, Any]
    ) -> AttemptsStatus | None:
        tenant, pseudonyms = asked["tenant"], asked["pseudonyms"]
        return self._standing.of(connection, row, tenant=tenant, pseudonyms=pseudonyms)

    def _record(
        self,
        connection: Connection,
        asked: dict[str, Any],
        accepted: bool,
        template_id: str | None,
        nonce: Nonce | None,
        level: str,
        by: By,
    ) -> LockedOut | Replayed | None:
        row = _one(connection, standing, asked)
        status = self._status(connection, row, asked)
        if accepted and template_id is None:
            raise ValueError("a subject that is not enrolled cannot be accepted")
        outcome = "accept" if accepted else "reject"
        refusal: LockedOut | Replayed | None = None
        new_status: AttemptsStatus | None = None
        try:
            if nonce is not None:
                spend(connection, nonce, key_id=row.api_key_id, used=row.used)
            self._standing.refuse_locked(status)
            of_contract = asked["contract_id"] in (None, row.contract_id)
            if (row.template_id if of_contract else None) != template_id:
                raise Superseded
            if accepted:
                new_status = status.cleared() if status and status.holds_something else None
                use = {"of_subject": row.subject_pk, "last_used_at": self._context.clock()}
                connection.execute(NOTE_USE, use)
            else:
                new_status = self._standing.after_failure(status)
        except LockedOut as error:
            outcome, refusal = "locked_out", LockedOut(error.retry_after_s, recorded=True)
        except Replayed:
            outcome, refusal = "replayed", Replayed(recorded=True)
        entry = Entry(
            "verify",
            outcome,
            by,
            asked["tenant"],
            asked["pseudonym"],
            detail=level,
            nonce=None if outcome == "replayed" else asked["nonce_digest"],
        )
        line = self._context.audit_log.append(connection, entry)
        if new_status is not None:
            self._standing.write(connection, row, asked["pseudonym"], new_status, line)
        return refusal


def _one(connection: Connection, query: Callable[[int], Any], asked: dict[str, Any]) -> Any:
    try:
        row = connection.execute(query(len(asked["pseudonyms"])), asked).one_or_none()
    except (ValueError, TypeError):
        # SQLite keeps any value in any column.
        raise StoreError(
            "a row about this subject was altered: run `veilface audit-log verify`"
        ) from None
    if row is None:
        raise UnknownTenant.named(asked["tenant"])
    return row
