"""The store of a deployment, opened from a URL and a keyring."""

import os
from collections.abc import Callable

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.keys.sealing import MasterKeyring
from templates.store import deployment, migrate, retention, rewrap
from templates.store.adoption import Adoption, adopt
from templates.store.api_keys import ApiKeys
from templates.store.attempts import Attempts
from templates.store.audit_log import PROGRAM, AuditLog, By
from templates.store.database import Database
from templates.store.deployment import Secrets
from templates.store.erasure import Erasure, Erasures
from templates.store.idempotency import Idempotency
from templates.store.identifiers import Clock, utc_now
from templates.store.known_calibrations import KnownCalibrations
from templates.store.lockout import LockoutPolicy
from templates.store.receipts import Receipt, ReceiptSigner
from templates.store.record_check import RecordProblem, check_records
from templates.store.rerotation import Rerotation
from templates.store.retention import RETENTION, Retention
from templates.store.schema import (
    ApiKeyRow,
    FailedAttemptsRow,
    IdempotencyRow,
    MasterKeyCheckRow,
    RotationKeyRow,
    SubjectRow,
    TemplateRow,
    UsedNonceRow,
)
from templates.store.stored_form import StoredForm, stored_form
from templates.store.subjects import Subjects
from templates.store.tenant_erasure import TenantErasures
from templates.store.tenants import Tenants
from templates.store.transfers import Transfers

_LOCKOUT = LockoutPolicy()
_TRIAL_ROW = 0  # the table's one row has number 1
_TRIAL_BYTES = 128 * 1024


class TemplateStore(Subjects):
    """Everything that Veilface keeps, in SQLite or PostgreSQL.

    Subjects are reached directly (:meth:`put`, :meth:`get`, :meth:`list`, :meth:`erase`), the rest
    by its own part: `tenants`, `tenant_erasures`, `rerotation`, `api_keys`, `attempts`,
    `idempotency`, `transfers`, `known_calibrations`, `audit_log`, `secrets`.
    """

    def __init__(
        self,
        url: str,
        keyring: MasterKeyring,
        *,
        pool_size: int = 5,
        max_overflow: int = 10,
        timeout: float = 10.0,
        clock: Clock = utc_now,
        lockout: LockoutPolicy = _LOCKOUT,
    ) -> None:
        database = Database(url, pool_size=pool_size, max_overflow=max_overflow, timeout=timeout)
        self.secrets = Secrets(database, keyring, clock)
        signer, audit_log = ReceiptSigner(self.secrets), AuditLog(database, self.secrets, clock)
        super().__init__(database, keyring, signer, audit_log, clock)
        self.attempts = Attempts(database, keyring, signer, audit_log, clock, lockout)
        self._erasures = Erasures(database, signer, audit_log, clock)
        self.tenants = Tenants(database, keyring, audit_log, clock)
        self.rerotation = Rerotation(database, keyring, self.tenants, audit_log)
        self.api_keys = ApiKeys(database, keyring, self.tenants, audit_log, clock)
        self.known_calibrations = KnownCalibrations(database, audit_log, clock)
        self.transfers = Transfers(database, signer, audit_log, clock)
        self.tenant_erasures = TenantErasures(
            database, signer, audit_log, self.tenants, self.api_keys, clock
        )
        self.idempotency = Idempotency(database, self.secrets, signer, audit_log, clock)

    def upgrade(self) -> Adoption:
        """Bring the schema to this program's version; safe when several workers start at once.

        Rows of a version that did not authenticate them are authenticated, once: see
        :func:`adoption.adopt`.
        """
        migrate.upgrade(self._database)
        deployment.mark_master_key(self._database, self._keyring, self._clock)
        self.check()
        self.audit_log.begin()
        return adopt(self._database, self.audit_log)

    def check(self) -> None:
        """Raise, naming the remedy, unless schema and master key are the right ones."""
        migrate.check(self._database)
        deployment.check_master_key(self._database, self._keyring)

    def check_records(self) -> tuple[RecordProblem, ...]:
        """Hold the rows that decide against the audit log; see :func:`check_records`."""
        return check_records(self._database, self.audit_log, self._clock())

    def close(self) -> None:
        """Close the idle connections of this process."""
        self._database.close()

    def stored_form(self, tenant: str, subject_id: str) -> StoredForm | None:
        """Return a subject's template as it is stored; see :func:`stored_form`."""
        return stored_form(self._database, self._keyring, tenant, subject_id)

    def erase(self, tenant: str, subject_id: str, *, by: By = PROGRAM) -> Erasure:
        """Erase a subject and sign a receipt; see :meth:`Erasures.erase`."""
        return self._erasures.erase(tenant, subject_id, by=by)

    def receipt(self, tenant: str, subject_id: str) -> Receipt | None:
        """Return the latest erasure receipt of a subject, or None."""
        return self._erasures.receipt(tenant, subject_id)

    def erase_expired(
        self, keep: Retention, *, by: By = RETENTION, batch: int = retention.BATCH
    ) -> int:
        """Erase the subjects whose retention has ended; see :func:`retention.erase_expired`."""
        return retention.erase_expired(
            self._database, self._erasures, self._clock, keep, by=by, batch=batch
        )

    def due(self, keep: Retention) -> int:
        """Count the subjects whose retention has ended."""
        return retention.due(self._database, self._clock, keep)

    def ping(self) -> None:
        """Raise :class:`StoreUnavailable` unless the database answers a query."""
        self._database.read(lambda connection: connection.execute(sa.select(1)).one())

    def ping_write(self) -> None:
        """Raise :class:`StoreError` unless the database takes a write; nothing changes by it.

        A full disk and a read-only database still answer queries. On a full disk a page or two
        often find room that an enrollment does not, so this writes as much as one.
        """
        trial = sa.insert(MasterKeyCheckRow).values(
            id=_TRIAL_ROW,
            wrapped_value=os.urandom(_TRIAL_BYTES),
            wrapping_key="",
            created_at=self._clock(),
        )

        def work(connection: Connection) -> None:
            connection.execute(trial)
            connection.execute(
                sa.delete(MasterKeyCheckRow).where(MasterKeyCheckRow.id == _TRIAL_ROW)
            )

        # One at a time: on PostgreSQL another worker's trial has the same row, not yet removed.
        self._database.write(work, lock="trial write")

    def pseudonym(self, tenant: str, subject_id: str) -> str:
        """Name of a subject in receipts, logs and the audit log."""
        return self._signer.pseudonym(tenant, subject_id)

    def receipt_public_key(self) -> bytes:
        """The 32 bytes that :func:`verify_receipt` checks this deployment's receipts with."""
        return self._signer.public_key()

    def rewrap(self, *, batch: int = 200, progress: Callable[[int], None] | None = None) -> int:
        """Bring all wrapped keys and secrets under the current key; see ``rewrap.rewrap``."""
        count = rewrap.rewrap(self._database, self._keyring, batch=batch, progress=progress)
        self._database.try_purge_log()
        return count

    def wrapping_keys(self) -> dict[str, int]:
        """Count what each master key still wraps; an absent key may be dropped from the file."""
        return rewrap.wrapping_keys(self._database)

    def purge(self, *, wait: float | None = None) -> bool:
        """Remove expired records, and on SQLite empty the write-ahead log.

        Parameters
        ----------
        wait
            Seconds that emptying the log may wait for readers, and so make writers wait; the
            store's timeout by default.

        Returns
        -------
        bool
            False if a reader outlasted the wait: the log is emptied another time.
        """
        self.idempotency.expire()
        self.attempts.expire()
        return self._database.purge_log(wait=wait)

    def compact(self) -> None:
        """Rewrite the tables of subjects and of keys, so that no page keeps what was erased.

        PostgreSQL keeps a removed row in its page until it vacuums; ``VACUUM FULL`` writes new
        files and locks each table meanwhile. SQLite overwrites as it deletes; there this gives
        the free pages back to the file system.
        """
        self._database.compact([table.__tablename__ for table in _HOLD_SUBJECT_DATA])

    def size(self) -> int:
        """Bytes that the database takes on disk, without the write-ahead log."""
        return self._database.size()


_HOLD_SUBJECT_DATA = (
    SubjectRow,
    TemplateRow,
    FailedAttemptsRow,
    IdempotencyRow,
    RotationKeyRow,
    ApiKeyRow,
    UsedNonceRow,
)
