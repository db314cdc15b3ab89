"""Secrets of the whole deployment, made once and renewed after a theft; the master key's check.

What a process has opened is good only while the database holds the same: so whatever needs a secret
runs through :meth:`Secrets.read` or :meth:`Secrets.write`, which ask the database in the same
transaction. A renewal (``templates.store.renewal``) is taken up by all workers with it, at the
moment of its commit.
"""

import functools
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import insert as postgresql_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert
from sqlalchemy.engine import Connection

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.database import Database
from templates.store.identifiers import Clock
from templates.store.schema import Base, MasterKeyCheckRow, SecretRow
from templates.store.secret import SECRET_BYTES, Secret, SecretName

SECRET_PURPOSE = "store-secret"  # noqa: S105 - a label, not a secret
CHECK_PURPOSE = "master-key-check"
PROOF_PURPOSE = "store-secret-renewal"
_CHECK_TEXT = b"veilface"

T = TypeVar("T")


@dataclass
class _Opened:
    """The secrets as the database held them at one moment, opened as far as they were needed."""

    sealed: dict[str, bytes] = field(default_factory=dict, repr=False)
    secrets: dict[str, Secret] = field(default_factory=dict, repr=False)


class Secrets:
    """Named random values: the same for every process, and wrapped by the master key.

    Parameters
    ----------
    database, keyring, clock
        Where they are kept, what wraps them, and what time it is.
    """

    def __init__(self, database: Database, keyring: MasterKeyring, clock: Clock) -> None:
        self._database = database
        self._keyring = keyring
        self._clock = clock
        self._opened = _Opened()
        self._lock = threading.Lock()

    def get(self, name: SecretName) -> Secret:
        """Return the secret of this name; the first call of any process makes it.

        Raises
        ------
        SealError
            If the master key that wrapped it is missing.
        """
        if (secret := self.opened(name)) is not None:
            return secret
        if name is not SecretName.CHAIN:
            # First: a renewal between the two is told by the one that was read before.
            self.existing(SecretName.CHAIN)
        self._keep(name, self._database.write(lambda connection: self._obtain(connection, name)))
        return self._required(name)

    def existing(self, name: SecretName) -> Secret | None:
        """Return what :meth:`get` returns where it was made before, and None where it was not.

        Raises
        ------
        SealError
            If the master key that wrapped it is missing.
        """
        if (secret := self.opened(name)) is not None:
            return secret
        sealed = self._database.read(lambda connection: _sealed(connection, name))
        if sealed is None:
            return None
        self._keep(name, sealed)
        return self._required(name)

    def opened(self, name: SecretName) -> Secret | None:
        """Return a secret that this process knows already, without asking the database."""
        opened = self._opened
        secret = opened.secrets.get(name)
        if secret is None and (sealed := opened.sealed.get(name)) is not None:
            secret = opened.secrets[name] = self._open(name, sealed)
        return secret

    def read(self, work: Callable[[Connection], T]) -> T:
        """:meth:`Database.read` under the secrets of the database that is read.

        Where they were renewed meanwhile, `work` runs again.
        """

        def attempt(connection: Connection) -> tuple[bool, T | StoreError]:
            before = self._opened
            outcome: T | StoreError
            try:
                outcome = work(connection)
            except StoreError as error:
                outcome = error
            # Afterwards: if nothing has changed by now, nothing had while `work` read.
            self.follow(connection)
            return self._opened is before, outcome

        while True:
            settled, outcome = self._database.read(attempt)
            if settled and isinstance(outcome, StoreError):
                raise outcome
            if settled:
                return outcome  # type: ignore[return-value]  # no error

    def write(self, work: Callable[[Connection], T], *, lock: str | None = None) -> T:
        """:meth:`Database.write` under the secrets of the database that is written."""
        return self._database.write(self._following(work), lock=lock)

    def write_alone(self, work: Callable[[Connection], T]) -> T:
        """:meth:`Database.write_alone` under the secrets of the database that is written."""
        return self._database.write_alone(self._following(work))

    def _following(self, work: Callable[[Connection], T]) -> Callable[[Connection], T]:
        def following(connection: Connection) -> T:
            # A renewal waits for this write, or this one for it: nothing changes from here on.
            self.follow(connection)
            return work(connection)

        return following

    def follow(self, connection: Connection) -> None:
        """Take up what another process changed: a renewal, or another master key.

        All secrets are renewed in one transaction, so the audit chain's tells of all.

        Raises
        ------
        StoreError
            If that one is gone.
        """
        known = self._opened.sealed.get(SecretName.CHAIN)
        if known is None or known == (now := _sealed(connection, SecretName.CHAIN)):
            return
        if now is None:
            raise StoreError(
                "the key of the audit log is missing: restore the database from a backup"
            )
        # All in one statement: between two of them, PostgreSQL may show another renewal.
        rows = connection.execute(sa.select(SecretRow.name, SecretRow.wrapped_value))
        newer = _Opened({row.name: row.wrapped_value for row in rows})
        chain = self._open(SecretName.CHAIN, newer.sealed[SecretName.CHAIN])
        newer.secrets[SecretName.CHAIN] = chain
        with self._lock:
            before = self.opened(SecretName.CHAIN)
            # Never back: a reader may still see the database as it was before a renewal.
            if before is None or len(chain.retired) >= len(before.retired):
                self._opened = newer

    def make(self, connection: Connection, name: SecretName) -> Secret | None:
        """Make a secret inside a transaction that is open already; None if there is one."""
        if not self._insert(connection, name):
            return None
        return self._open(name, self._obtain(connection, name))

    def renew(
        self, connection: Connection, name: SecretName, *, at: datetime, line: int
    ) -> Secret | None:
        """Draw a secret anew inside a transaction of :meth:`write_alone`; None if there is none.

        Processes, this one too, take it up when that is committed.
        """
        sealed = _sealed(connection, name)
        if sealed is None:
            return None
        before = self._open(name, sealed)
        fresh = before.renewed(
            at=at,
            line=line,
            prove=lambda value: self._keyring.seal(
                b"", purpose=PROOF_PURPOSE, bound_to=[name, value]
            ),
        )
        connection.execute(
            sa.update(SecretRow)
            .where(SecretRow.name == name)
            .values(**self._wrapped(name, fresh), created_at=at)
        )
        return fresh

    def was_drawn_now(self, name: SecretName, secret: Secret) -> bool:
        """Whether a secret was drawn under the master key in force: only who has that shows it."""
        proof = secret.proof
        if proof is None or sealed_key_id(proof) != self._keyring.current:
            return False
        try:
            self._keyring.open(proof, purpose=PROOF_PURPOSE, bound_to=[name, secret.value])
        except SealError:
            return False
        return True

    def _obtain(self, connection: Connection, name: SecretName) -> bytes:
        self._insert(connection, name)
        sealed = _sealed(connection, name)
        assert sealed is not None, "it was there, or was inserted"  # noqa: S101
        return sealed

    def _insert(self, connection: Connection, name: SecretName) -> bool:
        fresh = Secret(os.urandom(SECRET_BYTES))
        created = {"name": name, "created_at": self._clock()}
        return insert_once(connection, SecretRow, **self._wrapped(name, fresh), **created)

    def _wrapped(self, name: SecretName, secret: Secret) -> dict[str, Any]:
        sealed = self._keyring.seal(secret.to_bytes(), purpose=SECRET_PURPOSE, bound_to=[name])
        return {"wrapped_value": sealed, "wrapping_key": sealed_key_id(sealed)}

    def _open(self, name: SecretName, sealed: bytes) -> Secret:
        plain = self._keyring.open(sealed, purpose=SECRET_PURPOSE, bound_to=[name])
        return Secret.from_bytes(plain)

    def _keep(self, name: SecretName, sealed: bytes) -> None:
        with self._lock:
            self._opened.sealed.setdefault(name, sealed)

    def _required(self, name: SecretName) -> Secret:
        secret = self.opened(name)
        assert secret is not None, "it was kept"  # noqa: S101
        return secret

    def __repr__(self) -> str:
        return "Secrets()"


_SEALED = sa.select(SecretRow.wrapped_value).where(SecretRow.name == sa.bindparam("name"))


def _sealed(connection: Connection, name: SecretName) -> bytes | None:
    sealed: bytes | None = connection.execute(_SEALED, {"name": name}).scalar_one_or_none()
    return sealed


def insert_once(connection: Connection, table: type[Base], **values: object) -> bool:
    """Insert a row unless its key is taken; True if it was inserted."""
    statement = _insert_once(connection.dialect.name, table)
    return connection.execute(statement, values).first() is not None


@functools.cache
def _insert_once(dialect: str, table: type[Base]) -> sa.Executable:
    insert: Any = sqlite_insert if dialect == "sqlite" else postgresql_insert
    # The inserted row is asked for, because drivers do not agree on the row count here.
    statement: sa.Executable = (
        insert(table.__table__).on_conflict_do_nothing().returning(sa.literal(1))
    )
    return statement


def mark_master_key(database: Database, keyring: MasterKeyring, clock: Clock) -> None:
    """Leave a mark under the current master key in a database that has none yet."""

    def work(connection: Connection) -> None:
        sealed = keyring.seal(_CHECK_TEXT, purpose=CHECK_PURPOSE, bound_to=[])
        insert_once(
            connection,
            MasterKeyCheckRow,
            id=1,
            wrapped_value=sealed,
            wrapping_key=sealed_key_id(sealed),
            created_at=clock(),
        )

    database.write(work)


def check_master_key(database: Database, keyring: MasterKeyring) -> None:
    """Raise unless the keyring opens the mark that :func:`mark_master_key` left.

    Raises
    ------
    StoreError
        If the database carries no mark.
    SealError
        If it was made with another master key.
    """
    query = sa.select(MasterKeyCheckRow.wrapped_value)
    mark = database.read(lambda connection: connection.execute(query).scalar_one_or_none())
    if mark is None:
        raise StoreError("the database has no master key yet: run `veilface db upgrade`")
    try:
        opened = keyring.open(mark, purpose=CHECK_PURPOSE, bound_to=[])
    except SealError as error:
        raise SealError(f"this is not the master key of this database: {error}") from None
    if opened != _CHECK_TEXT:
        raise SealError("the database's mark of its master key is not ours: it was altered")
