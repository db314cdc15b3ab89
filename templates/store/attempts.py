"""Decisions: what they read, how failures are counted, and the lock that follows them.

A decision reads the subject's template, compares outside of any transaction, and is recorded in one
write, before anybody is told of it: its token is used up, the lock is checked, the failure is
counted, the audit log gets its line. If the template is another one by then, all of it is done
again. After a few times it is done inside the write, where nobody can replace the template.

Counts belong to the subject, enrolled or not. A second API key therefore gives no further attempts,
and a lock does not show whether the subject is enrolled. They live in the database only, so that
every worker counts the same and a restart forgets nothing.
"""

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Protocol, TypeVar

import sqlalchemy as sa
from sqlalchemy.orm import Session, aliased

from templates.store.audit_log import By, Entry
from templates.store.context import StoreContext
from templates.store.database import delete
from templates.store.identifiers import UnknownTenant, checked_subject_id
from templates.store.lockout import AttemptsStatus, LockedOut, LockoutPolicy, Replayed
from templates.store.schema import SEALED, AuditRow, FailedAttemptsRow, SubjectRow, TenantRow
from templates.store.subjects import SubjectTemplate, opened_template
from templates.store.tenants import RetiredRotation

COUNT_RETENTION = timedelta(days=90)
"""Time after the last failure until a count is forgotten; a disabled subject stays so."""
TRIES = 4
"""Times that a probe is compared outside of the write. Other writes wait for a comparison in it."""


@dataclass(frozen=True)
class Attempt:
    """What a probe is decided by: the tenant's current epoch, and the subject's template.

    `template` is None where there is none of the contract.
    """

    rotation_epoch: int
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


class _Superseded(Exception):
    """The template that was decided on is no longer the subject's; nothing was written."""


class Attempts:
    """Decides, and keeps the counts of failures."""

    def __init__(self, context: StoreContext, policy: LockoutPolicy) -> None:
        self._context = context
        self._policy = policy

    def decide(
        self,
        tenant: str,
        subject_id: str,
        compare: Callable[[Attempt], D],
        *,
        contract_id: str,
        token: str | None = None,
        by: By,
    ) -> D:
        """Decide a probe on a subject, and record the decision before it is returned.

        Of requests that run at the same time no more are answered than of requests that come one
        after the other: where the subject is locked by the time of the record, the decision is
        withheld, an accept too. The audit log has a line of that refusal.

        Parameters
        ----------
        compare
            Makes the decision; called again where the template was replaced meanwhile, the last
            time inside the write, so it must not write itself. It may raise
            :class:`RetiredRotation` for the same reason; what else it raises is raised, and then
            nothing is written.
        contract_id
            A template of another contract is treated as absent, and costs the same.
        token
            Digest of the one-use token or challenge that the decision uses up.

        Raises
        ------
        LockedOut, Replayed, UnknownTenant
        SealError
            If the row was altered or moved, or its master key is missing.
        """
        parameters = self._parameters(tenant, subject_id, token=token, contract_id=contract_id)
        database = self._context.database
        for _ in range(TRIES):
            with contextlib.suppress(_Superseded, RetiredRotation):
                with database.read() as session:
                    attempt = self._read(session, parameters)
                decided = compare(attempt)
                with database.write() as session:
                    refusal = self._record(session, parameters, attempt, decided, by)
                break
        else:
            with database.write() as session:
                attempt = self._read(session, parameters)
                decided = compare(attempt)
                refusal = self._record(session, parameters, attempt, decided, by)
        if refusal is not None:
            raise refusal
        return decided

    def reset(self, tenant: str, subject_id: str, *, by: By) -> bool:
        """Forget the consecutive failures on a subject, its lock and its being disabled.

        False if there was none of these.
        """
        parameters = self._parameters(tenant, subject_id)
        with self._context.database.write() as session:
            counts = _state_of(session, STATE_QUERY, parameters).FailedAttemptsRow
            lifts = counts is not None and counts.consecutive > 0
            if lifts:
                counts.consecutive = 0
            outcome = "reset" if lifts else "nothing_held"
            entry = Entry("lockout-reset", outcome, by, tenant, parameters["pseudonym"])
            self._context.audit_log.append(session, entry)
            return lifts

    def status(self, tenant: str, subject_id: str) -> AttemptsStatus | None:
        """What is counted of a subject; None if no attempt on it ever failed."""
        parameters = self._parameters(tenant, subject_id)
        with self._context.database.read() as session:
            return self._status(_state_of(session, STATE_QUERY, parameters).FailedAttemptsRow)

    def expire(self) -> int:
        """Remove the counts of subjects that did not fail for ninety days; returns how many."""
        due = FailedAttemptsRow.last_failed_at <= self._context.clock() - COUNT_RETENTION
        if self._policy.after:
            due &= FailedAttemptsRow.consecutive < self._policy.disable_at
        database = self._context.database
        # Most rounds have nothing to remove: they wait for no write.
        with database.read() as session:
            if session.scalar(sa.select(FailedAttemptsRow.pseudonym).where(due).limit(1)) is None:
                return 0
        with database.write() as session:
            return delete(session, FailedAttemptsRow, due)

    def _read(self, session: Session, parameters: Mapping[str, Any]) -> Attempt:
        """Read all that a decision needs, and refuse early what :meth:`_record` would refuse.

        One query, and as many bytes, whether the subject is enrolled or not.
        """
        state = _state_of(session, DECISION_QUERY, parameters)
        if (refusal := self._refusal(state)) is not None:
            raise refusal
        subject, template = state.SubjectRow, None
        if subject is not None:
            template = opened_template(subject, self._context.keyring)
        return Attempt(rotation_epoch=state.TenantRow.rotation_epoch, template=template)

    def _record(
        self,
        session: Session,
        parameters: Mapping[str, Any],
        attempt: Attempt,
        decided: Decided,
        by: By,
    ) -> LockedOut | Replayed | None:
        """Record a decision inside a write; returns why it must be withheld, or None.

        :class:`_Superseded` if the subject's template is not the one of `attempt`.
        """
        state = _state_of(session, STATE_QUERY, parameters)
        refusal = self._refusal(state)
        if refusal is None:
            self._count(session, state, parameters["pseudonym"], attempt, accepted=decided.accepted)
            outcome = "accept" if decided.accepted else "reject"
        else:
            refusal.recorded = True
            outcome = "replayed" if state.is_used else "locked_out"
        token = None if state.is_used else parameters["token"]
        tenant, pseudonym = parameters["tenant"], parameters["pseudonym"]
        entry = Entry("verify", outcome, by, tenant, pseudonym, decided.level, token)
        self._context.audit_log.append(session, entry)
        return refusal

    def _refusal(self, state: Any) -> LockedOut | Replayed | None:
        if state.is_used:
            return Replayed()
        return self._policy.refusal(self._status(state.FailedAttemptsRow), self._context.clock())

    def _count(
        self, session: Session, state: Any, pseudonym: str, attempt: Attempt, *, accepted: bool
    ) -> None:
        """Note the use or the failure in the rows of the subject."""
        subject, counts, now = state.SubjectRow, state.FailedAttemptsRow, self._context.clock()
        stored = None if subject is None else subject.template_id
        if stored != (None if attempt.template is None else attempt.template.template_id):
            raise _Superseded
        if accepted:
            if subject is None:
                raise ValueError("a subject that is not enrolled cannot be accepted")
            subject.last_used_at = now
            if counts is not None:
                counts.consecutive = 0
            return
        if counts is None:
            tenant_id = state.TenantRow.id
            counts = FailedAttemptsRow(tenant_id=tenant_id, pseudonym=pseudonym, consecutive=0)
            session.add(counts)
        counts.consecutive += 1
        counts.last_failed_at = now

    def _status(self, counts: FailedAttemptsRow | None) -> AttemptsStatus | None:
        if counts is None:
            return None
        return self._policy.status(counts.consecutive, counts.last_failed_at)

    def _parameters(
        self,
        tenant: str,
        subject_id: str,
        *,
        token: str | None = None,
        contract_id: str | None = None,
    ) -> dict[str, Any]:
        """Parameters of the queries."""
        subject_id = checked_subject_id(subject_id)
        pseudonym = self._context.signer.pseudonym(tenant, subject_id)
        return {
            "tenant": tenant,
            "subject_id": subject_id,
            "pseudonym": pseudonym,
            "place": pseudonym[:32],
            "token": token,
            "contract_id": contract_id,
        }


# Made once: building a statement costs more than running it.
STATE_QUERY: Any = (
    sa.select(
        TenantRow,
        FailedAttemptsRow,
        SubjectRow,
        sa.exists().where(AuditRow.token == sa.bindparam("token")).label("is_used"),
    )
    .outerjoin(
        FailedAttemptsRow,
        sa.and_(
            FailedAttemptsRow.tenant_id == TenantRow.id,
            FailedAttemptsRow.pseudonym == sa.bindparam("pseudonym"),
        ),
    )
    .outerjoin(
        SubjectRow,
        sa.and_(
            SubjectRow.tenant_id == TenantRow.id,
            SubjectRow.subject_id == sa.bindparam("subject_id"),
            SubjectRow.contract_id == sa.bindparam("contract_id"),
        ),
    )
    .where(TenantRow.name == sa.bindparam("tenant"))
)
"""What a decision is recorded against, in one row where there is the tenant; there is no subject
where it has no template of the contract."""

_OTHER = aliased(SubjectRow)


def _first_ciphertext(*conditions: Any) -> Any:
    query = sa.select(_OTHER.ciphertext).where(*conditions).order_by(_OTHER.id).limit(1)
    return query.scalar_subquery()


_STAND_IN = sa.func.coalesce(
    _first_ciphertext(_OTHER.id >= sa.bindparam("place")), _first_ciphertext()
)
"""The ciphertext of another subject, always the same one, which nobody opens: a template's bytes
take a time that would tell who is enrolled."""

DECISION_QUERY: Any = STATE_QUERY.options(SEALED).add_columns(
    sa.case((SubjectRow.id.is_(None), _STAND_IN)).label("stand_in")
)
"""What a decision reads."""


def _state_of(session: Session, query: Any, parameters: Mapping[str, Any]) -> Any:
    """The one row of a query; :class:`UnknownTenant` where there is none."""
    state = session.execute(query, parameters).one_or_none()
    if state is None:
        raise UnknownTenant(f"there is no tenant {parameters['tenant']!r}")
    return state
