"""The store of a deployment, opened from a URL and a keyring."""

import os

import sqlalchemy as sa

from templates.keys.sealing import MasterKeyring
from templates.store import migrate
from templates.store.api_keys import ApiKeys
from templates.store.attempts import Attempts
from templates.store.audit_chain import BrokenAuditLog, begin_chain
from templates.store.context import StoreContext
from templates.store.database import Database
from templates.store.erasure import Erasures
from templates.store.identifiers import Clock, utc_now
from templates.store.lockout import LockoutPolicy
from templates.store.rerotation import Rerotation
from templates.store.schema import AuditHeadRow, SecretRow
from templates.store.secrets import SecretName
from templates.store.subjects import Subjects
from templates.store.tenants import Tenants

_LOCKOUT = LockoutPolicy()
_TRIAL_NAME = "trial-write"
_TRIAL_BYTES = 128 * 1024


class TemplateStore(StoreContext):
    """Everything that Veilface keeps, in SQLite or PostgreSQL.

    Each part has its own attribute; this class has only what concerns all of them. What is done
    beside a service in use, or while it is stopped, are functions: :func:`verify_audit_log`,
    :func:`archive_audit_log`, :func:`rewrap_keys`, :func:`renew_secrets`.
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
        super().__init__(database, keyring, clock)
        self.tenants = Tenants(self)
        self.api_keys = ApiKeys(self)
        self.subjects = Subjects(self)
        self.attempts = Attempts(self, lockout)
        self.erasures = Erasures(self)
        self.rerotation = Rerotation(self, self.tenants)

    def upgrade(self) -> None:
        """Bring the schema to this program's version; safe when several workers start at once.

        :class:`BrokenAuditLog` if the audit log has begun and its secret is gone, and
        :class:`SealError` if the database was made with another master key.
        """
        migrate.upgrade(self.database)
        with self.database.write() as session:
            made = self.secrets.make_missing(session)
            has_begun = session.scalar(sa.select(AuditHeadRow.id)) is not None
            if made and (has_begun or SecretName.CHAIN not in made):
                raise BrokenAuditLog(
                    f"secrets of the deployment are missing ({', '.join(sorted(made))}): "
                    "restore the database from a backup"
                )
            if made:
                begin_chain(session, made[SecretName.CHAIN])
        self.check()

    def check(self) -> None:
        """Raise, naming the remedy, unless schema and master key are the right ones."""
        migrate.check(self.database)
        self.secrets.load()
        self.secrets.get(SecretName.CHAIN)

    def close(self) -> None:
        """Close the idle connections of this process."""
        self.database.close()

    def ping(self) -> None:
        """Raise :class:`StoreUnavailable` unless the database answers a query."""
        with self.database.read() as session:
            session.execute(sa.select(1))

    def ping_write(self) -> None:
        """Raise :class:`StoreError` unless the database takes a write; nothing changes by it.

        A full disk and a read-only database still answer queries. On a full disk a page or two
        often find room that an enrollment does not, so this writes as much as one.
        """
        trial = SecretRow(name=_TRIAL_NAME, wrapped_key=os.urandom(_TRIAL_BYTES))
        with self.database.write() as session:
            session.add(trial)
            session.flush()
            session.delete(trial)

    def purge(self) -> bool:
        """Remove expired records, and on SQLite empty the write-ahead log.

        False if a reader outlasted the wait: the log is emptied another time.
        """
        try:
            self.attempts.expire()
        finally:
            emptied = self.database.purge_log()
        return emptied
