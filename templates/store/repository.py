"""The store of a deployment, opened from a URL and a keyring."""

import os
from collections.abc import Callable
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.keys.sealing import MasterKeyring
from templates.store import migrate
from templates.store.api_keys import ApiKeys
from templates.store.attempts import Attempts
from templates.store.audit_archive import Archive, archive_lines
from templates.store.audit_chain import Anchor, BrokenAuditLog, begin_chain
from templates.store.audit_log import PROGRAM, By
from templates.store.audit_verification import Verification, verify_audit_log
from templates.store.context import StoreContext
from templates.store.database import Database
from templates.store.erasure import Erasures
from templates.store.identifiers import Clock, utc_now
from templates.store.lockout import LockoutPolicy
from templates.store.renewal import Renewed, renew_secrets
from templates.store.rerotation import Rerotation
from templates.store.retention import RetentionJob
from templates.store.rewrap import WrappedKeys
from templates.store.schema import AuditHeadRow, SecretRow
from templates.store.secrets import SecretName
from templates.store.subjects import Subjects
from templates.store.tenants import Tenants

_LOCKOUT = LockoutPolicy()
_TRIAL_NAME = "trial-write"
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
        self._context = context = StoreContext.open(database, keyring, clock)
        self.database = database
        self.secrets = context.secrets
        self.signer = context.signer
        self.audit_log = context.audit_log
        self.tenants = Tenants(context)
        self.api_keys = ApiKeys(context)
        self.subjects = Subjects(context)
        self.attempts = Attempts(context, lockout)
        self.erasures = Erasures(context)
        self.retention = RetentionJob(context, self.erasures)
        self.rerotation = Rerotation(context, self.tenants)
        self.wrapped_keys = WrappedKeys(context)

    def upgrade(self) -> None:
        """Bring the schema to this program's version; safe when several workers start at once.

        :class:`BrokenAuditLog` if the audit log has begun and its secret is gone, and
        :class:`SealError` if the database was made with another master key.
        """
        migrate.upgrade(self.database)
        with self.database.write() as session:
            self._set_up(session)
        self.check()

    def _set_up(self, session: Session) -> None:
        made = self.secrets.make_missing(session)
        if not made:
            return
        has_begun = session.scalar(sa.select(AuditHeadRow.id)) is not None
        if has_begun or SecretName.CHAIN not in made:
            raise BrokenAuditLog(
                f"secrets of the deployment are missing ({', '.join(sorted(made))}): "
                "restore the database from a backup"
            )
        begin_chain(session, made[SecretName.CHAIN])

    def check(self) -> None:
        """Raise, naming the remedy, unless schema and master key are the right ones."""
        migrate.check(self.database)
        self.secrets.load()
        self.secrets.get(SecretName.CHAIN)

    def verify_audit_log(
        self, *, anchor: Anchor | None = None, progress: Callable[[int], None] | None = None
    ) -> Verification:
        """Walk over the audit log, and hold rows against it (:func:`verify_audit_log`)."""
        return verify_audit_log(self._context, self.api_keys, anchor=anchor, progress=progress)

    def archive_audit_log(self, file: Path, *, through: int | None, by: By = PROGRAM) -> Archive:
        """Move old lines of the audit log into a file (:func:`archive_lines`)."""
        return archive_lines(self._context, file, through=through, by=by)

    def renew_secrets(self, archive: Path, *, by: By = PROGRAM) -> Renewed:
        """Make every secret anew after a theft (:func:`renew_secrets`)."""
        return renew_secrets(self._context, self.api_keys, archive, by=by)

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
        trial = SecretRow(name=_TRIAL_NAME, wrapped_key=os.urandom(_TRIAL_BYTES), wrapping_key="")
        trial.created_at = self._context.clock()
        with self.database.write() as session:
            session.add(trial)
            session.flush()
            session.delete(trial)

    def purge(self) -> bool:
        """Remove expired records, and on SQLite empty the write-ahead log.

        False if a reader outlasted the wait: the log is emptied another time.
        """
        self.attempts.expire()
        return self.database.purge_log()
