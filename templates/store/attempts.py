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
from functools import partial
from typing import Any, Protocol, TypeVar, cast

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.orm import aliased

from templates.store.audit_log import By, Entry
from templates.store.context import StoreContext
from templates.store.identifiers import UnknownTenant, checked_subject_id
from templates.store.lockout import (
    AttemptsStatus,
    LockedOut,
    LockoutPolicy,
    Replayed,
    Superseded,
)
from templates.store.schema import (
    AuditRow,
    FailedAttemptsRow,
    SubjectRow,
    TemplateRow,
    TenantRow,
)
from templates.store.subject_rows import TEMPLATE_COLUMNS, SubjectTemplate, opened_template
from templates.store.tenants import RetiredRotation

COUNT_RETENTION = timedelta(days=90)
"""Time after the last failure until a count is forgotten; a disabled subject stays so."""
TRIES = 4
"""Times that a probe is compared outside of the write. Other writes wait for a comparison in it."""


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
        tenant, subject_id
            Whom the probe is compared with.
        compare
            Makes the decision; called again where the template was replaced meanwhile, the last
            time inside the write, so it must not write itself. It may raise
            :class:`RetiredRotation` for the same reason; what else it raises is raised, and then
            nothing is written.
        contract_id
            A template of another contract is treated as absent, and costs the same.
        token
            Digest of the one-use token or challenge that the decision uses up.
        by
            Who asks.

        Raises
        ------
        LockedOut, Replayed, UnknownTenant
        SealError
            If the row was altered or moved, or its master key is missing.
        """
        parameters = self._parameters(tenant, subject_id, token=token, contract_id=contract_id)
        database, read = self._context.database, partial(self._read, parameters)
        record = partial(self._record, parameters, by)

        def decide_in_write(connection: Connection) -> tuple[D, LockedOut | Replayed | None]:
            attempt = read(connection)
            decided = compare(attempt)
            return decided, record(attempt, decided, connection)

        for _ in range(TRIES):
            with contextlib.suppress(Superseded, RetiredRotation):
                attempt = database.read(read)
                decided = compare(attempt)
                refusal = database.write(partial(record, attempt, decided))
                break
        else:
            decided, refusal = database.write(decide_in_write)
        if refusal is not None:
            raise refusal
        return decided

    def reset(self, tenant: str, subject_id: str, *, by: By) -> bool:
        """Forget the consecutive failures on a subject, its lock and its being disabled.

        Returns
        -------
        bool
            False if there was none of these. The total stays.
        """
        parameters = self._parameters(tenant, subject_id)

        def work(connection: Connection) -> bool:
            row = _row_of(connection, RECORD_QUERY, parameters)
            status = self._status(row)
            lifts = status is not None and not status.is_clear
            if status is not None and lifts:
                _write_counts(connection, row, parameters["pseudonym"], status.cleared())
            outcome = "reset" if lifts else "nothing_held"
            entry = Entry("lockout-reset", outcome, by, tenant, parameters["pseudonym"])
            self._context.audit_log.append(connection, entry)
            return lifts

        return self._context.database.write(work)

    def status(self, tenant: str, subject_id: str) -> AttemptsStatus | None:
        """What is counted of a subject; None if no attempt on it ever failed."""
        parameters = self._parameters(tenant, subject_id)
        row = self._context.database.read(
            lambda connection: _row_of(connection, RECORD_QUERY, parameters)
        )
        return self._status(row)

    def expire(self) -> int:
        """Remove the counts of subjects that did not fail for ninety days; returns how many."""
        due = FailedAttemptsRow.last_failed_at <= self._context.clock() - COUNT_RETENTION
        if self._policy.after:
            due &= FailedAttemptsRow.consecutive < self._policy.disable_at
        database = self._context.database
        # Read first: a round that has nothing to remove, and most have not, waits for no write.
        some = sa.select(FailedAttemptsRow.pseudonym).where(due).limit(1)
        if database.read(lambda connection: connection.execute(some).first()) is None:
            return 0
        statement = sa.delete(FailedAttemptsRow).where(due)
        return database.write(lambda connection: connection.execute(statement).rowcount)

    def _read(self, parameters: Mapping[str, Any], connection: Connection) -> Attempt:
        """Read all that a decision needs, and refuse early what :meth:`_record` would refuse.

        One query, and as many bytes, whether the subject is enrolled or not.
        """
        row = _row_of(connection, DECISION_QUERY, parameters)
        if row.is_used:
            raise Replayed
        self._policy.refuse_locked(self._status(row), self._context.clock())
        template = None
        if row.template_id is not None:
            template = opened_template(row, self._context.keyring)
        return Attempt(rotation_epoch=row.current_epoch, template=template)

    def _record(
        self,
        parameters: Mapping[str, Any],
        by: By,
        attempt: Attempt,
        decided: Decided,
        connection: Connection,
    ) -> LockedOut | Replayed | None:
        """Record a decision inside a write; returns why it must be withheld, or None.

        Raises
        ------
        Superseded
            If the subject's template is not the one of `attempt`.
        """
        template_id = None if attempt.template is None else attempt.template.template_id
        if decided.accepted and template_id is None:
            raise ValueError("a subject that is not enrolled cannot be accepted")
        pseudonym = parameters["pseudonym"]
        row, now = _row_of(connection, RECORD_QUERY, parameters), self._context.clock()
        status, spent = self._status(row), parameters["token"]
        refusal: LockedOut | Replayed | None = None
        outcome = "accept" if decided.accepted else "reject"
        try:
            if row.is_used:
                raise Replayed(recorded=True)
            self._policy.refuse_locked(status, now)
        except LockedOut as error:
            outcome, refusal = "locked_out", LockedOut(error.retry_after_s, recorded=True)
        except Replayed as error:
            outcome, refusal, spent = "replayed", error, None
        else:
            stored = row.template_id if row.contract_id == parameters["contract_id"] else None
            if stored != template_id:
                raise Superseded
            if not decided.accepted:
                failed = (0, 0) if status is None else (status.consecutive, status.total)
                new = self._policy.status(failed[0] + 1, failed[1] + 1, now)
                _write_counts(connection, row, pseudonym, new)
            else:
                use = {"of_subject": row.subject_pk, "last_used_at": now}
                connection.execute(_NOTE_USE, use)
                if status is not None and not status.is_clear:
                    _write_counts(connection, row, pseudonym, status.cleared())
        entry = Entry("verify", outcome, by, parameters["tenant"], pseudonym, decided.level, spent)
        self._context.audit_log.append(connection, entry)
        return refusal

    def _status(self, row: Any) -> AttemptsStatus | None:
        if row.counted is None:
            return None
        return self._policy.status(row.consecutive, row.total, row.last_failed_at)

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
_COUNTS = ("consecutive", "total", "last_failed_at")
_COMMON = (
    *(getattr(FailedAttemptsRow, name) for name in _COUNTS),
    FailedAttemptsRow.pseudonym.label("counted"),
    sa.exists(sa.select(AuditRow.sequence).where(AuditRow.token == sa.bindparam("token"))).label(
        "is_used"
    ),
)
_IS_COUNTED = sa.and_(
    FailedAttemptsRow.tenant_id == TenantRow.id,
    FailedAttemptsRow.pseudonym == sa.bindparam("pseudonym"),
)
_IS_SUBJECT = sa.and_(
    SubjectRow.tenant_id == TenantRow.id,
    SubjectRow.subject_id == sa.bindparam("subject_id"),
)
_IS_TEMPLATE = TemplateRow.subject_pk == SubjectRow.id
_OTHER = aliased(TemplateRow)


def _first_ciphertext(*conditions: Any) -> Any:
    query = sa.select(_OTHER.ciphertext).where(*conditions).order_by(_OTHER.subject_pk).limit(1)
    return query.scalar_subquery()


_STAND_IN = sa.func.coalesce(
    _first_ciphertext(_OTHER.subject_pk >= sa.bindparam("place")), _first_ciphertext()
)
"""The ciphertext of another subject, always the same one, which nobody opens: a template's bytes
take a time that would tell who is enrolled."""

DECISION_QUERY: Any = (
    sa.select(
        *TEMPLATE_COLUMNS,
        sa.case((TemplateRow.ciphertext.is_(None), _STAND_IN)).label("stand_in"),
        TenantRow.rotation_epoch.label("current_epoch"),
        *_COMMON,
    )
    .select_from(TenantRow)
    .outerjoin(FailedAttemptsRow, _IS_COUNTED)
    .outerjoin(SubjectRow, _IS_SUBJECT)
    .outerjoin(
        TemplateRow, sa.and_(_IS_TEMPLATE, TemplateRow.contract_id == sa.bindparam("contract_id"))
    )
    .where(TenantRow.name == sa.bindparam("tenant"))
)
"""What a decision reads, in one row where there is the tenant; the columns of the template are NULL
where the subject has none of the contract."""

RECORD_QUERY: Any = (
    sa.select(
        TenantRow.id.label("tenant_id"),
        SubjectRow.id.label("subject_pk"),
        TemplateRow.template_id,
        TemplateRow.contract_id,
        *_COMMON,
    )
    .select_from(TenantRow)
    .outerjoin(FailedAttemptsRow, _IS_COUNTED)
    .outerjoin(SubjectRow, _IS_SUBJECT)
    .outerjoin(TemplateRow, _IS_TEMPLATE)
    .where(TenantRow.name == sa.bindparam("tenant"))
)
"""What a decision is recorded against, in one row where there is the tenant."""

_failures = cast(sa.Table, FailedAttemptsRow.__table__)
_subjects = cast(sa.Table, SubjectRow.__table__)
_FIRST_COUNTS = sa.insert(_failures)
_NEXT_COUNTS = sa.update(_failures).where(
    _failures.c.tenant_id == sa.bindparam("of_tenant"),
    _failures.c.pseudonym == sa.bindparam("of_pseudonym"),
)
_NOTE_USE = sa.update(_subjects).where(_subjects.c.id == sa.bindparam("of_subject"))


def _row_of(connection: Connection, query: Any, parameters: Mapping[str, Any]) -> Any:
    """The one row of a query; :class:`UnknownTenant` where there is none."""
    row = connection.execute(query, parameters).one_or_none()
    if row is None:
        raise UnknownTenant.of_name(parameters["tenant"])
    return row


def _write_counts(connection: Connection, row: Any, pseudonym: str, status: AttemptsStatus) -> None:
    counts = {name: getattr(status, name) for name in _COUNTS}
    if row.counted is None:
        identity = {"tenant_id": row.tenant_id, "pseudonym": pseudonym}
        connection.execute(_FIRST_COUNTS, {**identity, **counts})
    else:
        identity = {"of_tenant": row.tenant_id, "of_pseudonym": pseudonym}
        connection.execute(_NEXT_COUNTS, {**identity, **counts})
