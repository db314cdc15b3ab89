"""Secrets of the whole deployment, made once, and the check of the master key."""

import functools
import os
import threading
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects.postgresql import insert as postgresql_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert
from sqlalchemy.engine import Connection

from templates.errors import SealError, StoreError
from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.database import Database
from templates.store.identifiers import Clock, checked_opaque_id
from templates.store.schema import Base, MasterKeyCheckRow, SecretRow

SECRET_PURPOSE = "store-secret"  # noqa: S105 - a label, not a secret
CHECK_PURPOSE = "master-key-check"
_CHECK_TEXT = b"veilface"


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
        self._opened: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def get(self, name: str) -> bytes:
        """Return 32 random bytes of this name; the first call of any process makes them.

        Raises
        ------
        SealError
            If the master key that wrapped it is missing.
        """
        checked_opaque_id(name, what="secret's name")
        # Without the lock: a transaction that needs a known secret must not wait for a thread
        # that obtains another one, and so waits for that transaction.
        if (secret := self._opened.get(name)) is not None:
            return secret
        with self._lock:
            if name not in self._opened:
                self._opened[name] = self._database.write(
                    lambda connection: self._obtain(connection, name)
                )
            return self._opened[name]

    def existing(self, name: str) -> bytes | None:
        """Return what :meth:`get` returns where it was made before, and None where it was not.

        Raises
        ------
        SealError
            If the master key that wrapped it is missing.
        """
        if (secret := self._opened.get(name)) is not None:
            return secret
        secret = self._database.read(lambda connection: self._read(connection, name))
        if secret is not None:
            with self._lock:
                self._opened[name] = secret
        return secret

    def make(self, connection: Connection, name: str) -> bytes | None:
        """Make a secret inside a transaction that is open already; None if there is one."""
        checked_opaque_id(name, what="secret's name")
        return self._read(connection, name) if self._insert(connection, name) else None

    def _obtain(self, connection: Connection, name: str) -> bytes:
        self._insert(connection, name)
        value = self._read(connection, name)
        assert value is not None, "it was there, or was inserted"  # noqa: S101
        return value

    def _insert(self, connection: Connection, name: str) -> bool:
        fresh = self._keyring.seal(os.urandom(32), purpose=SECRET_PURPOSE, bound_to=[name])
        return insert_once(
            connection,
            SecretRow,
            name=name,
            wrapped_value=fresh,
            wrapping_key=sealed_key_id(fresh),
            created_at=self._clock(),
        )

    def _read(self, connection: Connection, name: str) -> bytes | None:
        wrapped = connection.execute(
            sa.select(SecretRow.wrapped_value).where(SecretRow.name == name)
        ).scalar_one_or_none()
        if wrapped is None:
            return None
        return self._keyring.open(wrapped, purpose=SECRET_PURPOSE, bound_to=[name])

    def __repr__(self) -> str:
        return "Secrets()"


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
