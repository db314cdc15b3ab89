"""The store of a deployment, opened from a URL and a keyring."""

import os

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.keys.sealing import MasterKeyring
from templates.store import deployment, migrate
from templates.store.api_keys import ApiKeys
from templates.store.attempts import Attempts
from templates.store.context import StoreContext
from templates.store.database import Database
from templates.store.erasure import Erasures
from templates.store.identifiers import Clock, utc_now
from templates.store.lockout import LockoutPolicy
from templates.store.nonces import Nonces
from templates.store.record_check import RecordProblem, check_records
from templates.store.renewal import Renewal
from templates.store.rerotation import Rerotation
from templates.store.retention import RetentionJob
from templates.store.rewrap import WrappedKeys
from templates.store.schema import (
    ApiKeyRow,
    FailedAttemptsRow,
    MasterKeyCheckRow,
    RotationKeyRow,
    SubjectRow,
    TemplateRow,
    UsedNonceRow,
)
from templates.store.subjects import Subjects
from templates.store.tenant_erasure import TenantErasures
from templates.store.tenants import Tenants

_LOCKOUT = LockoutPolicy()
_TRIAL_ROW = 0  # the table's one row has number 1
_TRIAL_BYTES = 128 * 1024


class TemplateStore:
    """Everything that Veilface keeps, in SQLite or PostgreSQL.

    Each part has its own attribute; this class has only what concerns all of them.
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
        self._context = context = StoreContext.of(database, keyring, clock)
        self.database = database
        self.secrets = context.secrets
        self.signer = context.signer
        self.audit_log = context.audit_log
        self.tenants = Tenants(context)
        self.api_keys = ApiKeys(context, self.tenants)
        self.nonces = Nonces(context)
        self.subjects = Subjects(context, self.nonces)
        self.attempts = Attempts(context, self.nonces, lockout)
        self.erasures = Erasures(context)
        self.retention = RetentionJob(context, self.erasures)
        self.rerotation = Rerotation(context, self.tenants)
        self.tenant_erasures = TenantErasures(context, self.tenants, self.api_keys)
        self.wrapped_keys = WrappedKeys(context)
        self.renewal = Renewal(context, self.tenants)

    def upgrade(self) -> None:
        """Bring the schema to this program's version; safe when several workers start at once."""
        context = self._context
        migrate.upgrade(self.database)
        deployment.mark_master_key(self.database, context.keyring, context.clock)
        self.check()
        self.audit_log.begin()
        self.signer.prepare()  # so that the first reader makes no secret, which is a write

    def check(self) -> None:
        """Raise, naming the remedy, unless schema and master key are the right ones."""
        migrate.check(self.database)
        deployment.check_master_key(self.database, self._context.keyring)

    def check_records(self) -> tuple[RecordProblem, ...]:
        """Hold the rows that decide against the audit log; see :func:`check_records`."""
        return check_records(self._context)

    def close(self) -> None:
        """Close the idle connections of this process."""
        self.database.close()

    def ping(self) -> None:
        """Raise :class:`StoreUnavailable` unless the database answers a query."""
        self.database.read(lambda connection: connection.execute(sa.select(1)).one())

    def ping_write(self) -> None:
        """Raise :class:`StoreError` unless the database takes a write; nothing changes by it.

        A full disk and a read-only database still answer queries. On a full disk a page or two
        often find room that an enrollment does not, so this writes as much as one.
        """
        trial = sa.insert(MasterKeyCheckRow).values(
            id=_TRIAL_ROW,
            wrapped_value=os.urandom(_TRIAL_BYTES),
            wrapping_key="",
            created_at=self._context.clock(),
        )

        def work(connection: Connection) -> None:
            connection.execute(trial)
            connection.execute(
                sa.delete(MasterKeyCheckRow).where(MasterKeyCheckRow.id == _TRIAL_ROW)
            )

        # One at a time: on PostgreSQL another worker's trial has the same row, not yet removed.
        self.database.write(work, lock="trial write")

    def purge(self) -> bool:
        """Remove expired records, and on SQLite empty the write-ahead log.

        Returns
        -------
        bool
            False if a reader outlasted the wait: the log is emptied another time.
        """
        self.attempts.expire()
        return self.database.purge_log()

    def compact(self) -> None:
        """Rewrite the tables of subjects and of keys, so that no page keeps what was erased.

        PostgreSQL keeps a removed row in its page until it vacuums; ``VACUUM FULL`` writes new
        files and locks each table meanwhile. SQLite overwrites as it deletes; there this gives
        the free pages back to the file system.
        """
        self.database.compact([table.__tablename__ for table in _HOLD_SUBJECT_DATA])


_HOLD_SUBJECT_DATA = (
    SubjectRow,
    TemplateRow,
    FailedAttemptsRow,
    RotationKeyRow,
    ApiKeyRow,
    UsedNonceRow,
)
