"""The connection to SQLite or PostgreSQL: transactions, waits, and errors in our own words.

One :class:`Database` may be used by many threads; each process opens its own. Writes are one at a
time over all processes and hosts, on both databases. So what a write has read stays true until it
commits, and no two writes wait for each other.
"""

import contextlib
import hashlib
import sqlite3
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session

from templates.errors import StoreBusy, StoreError, StoreUnavailable
from templates.store.engine import checked_url, make_engine, sqlite_file
from templates.store.schema import Base
from templates.store.turn import next_in_line

try:
    import psycopg

    _POSTGRES: tuple[type[Exception], ...] = (psycopg.Error,)
    _UNANSWERED: tuple[type[Exception], ...] = (psycopg.OperationalError, psycopg.InterfaceError)
except ModuleNotFoundError:  # of the extra `postgres`, without which there is SQLite
    _POSTGRES = _UNANSWERED = ()
_DATABASE_ERRORS: tuple[type[Exception], ...] = (
    SQLAlchemyError,
    sqlite3.Error,
    OSError,
    *_POSTGRES,
)
_EMPTY_LOG = "PRAGMA wal_checkpoint(TRUNCATE)"
PURGE_WAIT_S = 0.25
"""Longest that emptying SQLite's log waits for readers, and so makes writers wait."""
_UNAVAILABLE_CLASSES = {"08", "53", "57", "58"}  # connection, resources, operator, system
_TABLE_MISSING = (
    "a table is missing: run `veilface db upgrade`; if it is missing afterwards, restore a backup"
)
_OTHER_VERSION = "the database was made by another version of this program: make it anew"
_LOCK_NOT_AVAILABLE, _DEADLOCK, _SERIALISATION = "55P03", "40P01", "40001"

# The server takes the columns in their order, so the limit, in milliseconds, holds for the lock.
_BEGIN_WRITE = sa.select(
    sa.func.set_config("lock_timeout", sa.bindparam("limit", type_=sa.String), True),
    sa.func.pg_advisory_xact_lock(
        int.from_bytes(hashlib.sha256(b"veilface write").digest()[:8], "big", signed=True)
    ),
)


class Database:
    """The engine of a process, and the two ways to use it: :meth:`read` and :meth:`write`.

    Parameters
    ----------
    url
        ``sqlite:///path``, a file on a local disk, made with mode 0600, or
        ``postgresql://user@host/name``.
    pool_size, max_overflow
        Connections kept, and further ones under load, in each process.
    timeout
        Seconds to wait for a connection, or for another write of any process.
    """

    def __init__(
        self, url: str, *, pool_size: int = 5, max_overflow: int = 10, timeout: float = 10.0
    ) -> None:
        self.url = checked_url(url)
        self.is_sqlite = self.url.get_backend_name() == "sqlite"
        self._file = sqlite_file(self.url) if self.is_sqlite else None
        self._timeout = timeout
        self._writing = threading.Lock()
        self.engine = make_engine(
            self.url, timeout=timeout, pool_size=pool_size, max_overflow=max_overflow
        )
        self._readers = self.engine
        self._opened = _identity(self._file)
        if self.is_sqlite:
            # SQLite would make an empty file, and the connection would stay with that one.
            sa.event.listen(self.engine, "do_connect", lambda *_: self._require_file())
        else:
            self._readers = self.engine.execution_options(isolation_level="AUTOCOMMIT")

    @contextlib.contextmanager
    def read(self) -> Iterator[Session]:
        """Give a session; what it sees is committed.

        An error in the block is a :class:`StoreError` in our own words, without a statement, its
        parameters or a row.
        """
        with _translating(), Session(self._readers) as session:
            if self.is_sqlite:
                _driver(session.connection()).execute("BEGIN")
                self._require_file()
            yield session

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[Session]:
        """:meth:`read`, where all queries see the same moment; no write waits for it."""
        with self.read() as session:
            if not self.is_sqlite:  # whose readers see one moment anyway
                session.connection(execution_options={"isolation_level": "REPEATABLE READ"})
            yield session

    @contextlib.contextmanager
    def write(self, *, timeout: float | None = None) -> Iterator[Session]:
        """Give a session in one transaction, while no other write runs, and commit it.

        Keep the block short. `timeout` replaces the database's own for waiting on other writes;
        0 waits without limit. SQLite ignores it. After :class:`StoreBusy` nothing was written;
        after :class:`StoreUnavailable` it may have been.
        """
        until = time.monotonic() + self._timeout
        # Rows stay readable after the commit.
        session = Session(self.engine, expire_on_commit=False)
        # Threads queue here in turn: SQLite's own lock is polled and knows no order, and on
        # PostgreSQL each that waits would hold a connection that readers need.
        with _translating(), self._turn_of_threads(), session, session.begin():
            if self.is_sqlite:
                connection = session.connection()
                with self._turn(until), self._patience(connection, until) as driver:
                    driver.execute("BEGIN IMMEDIATE")
                self._require_file()
            else:
                limit = self._timeout if timeout is None else timeout
                session.execute(_BEGIN_WRITE, {"limit": str(round(1000 * limit))})
            yield session

    def purge_log(self) -> bool:
        """Move SQLite's write-ahead log into the database file and empty it.

        What a transaction removed may still stand in the log until then. It is called after the
        commit, so it never raises: False where a reader outlasted the wait, or the database failed.
        Nothing to do on PostgreSQL.
        """
        if not self.is_sqlite:
            return True
        with (
            contextlib.suppress(*_DATABASE_ERRORS, StoreError),
            self._turn_of_threads(),
            self._turn(time.monotonic() + PURGE_WAIT_S),
            self.engine.connect() as connection,
            self._patience(connection, time.monotonic() + PURGE_WAIT_S) as driver,
        ):
            busy, _, _ = driver.execute(_EMPTY_LOG).fetchone()
            return not busy
        return False

    def compact(self) -> None:
        """Rewrite all tables (PostgreSQL) or the file (SQLite), so that no page keeps removed rows.

        PostgreSQL keeps a removed row in its page until it vacuums; ``VACUUM FULL`` writes new
        files and locks each table meanwhile. SQLite overwrites as it deletes; there this gives
        the free pages back to the file system.
        """
        autocommit = self.engine.execution_options(isolation_level="AUTOCOMMIT")
        with (
            _translating(),
            self._turn_of_threads(),
            self._turn(time.monotonic() + self._timeout),
            autocommit.connect() as connection,
        ):
            if self.is_sqlite:
                _driver(connection).execute("VACUUM")
            for table in () if self.is_sqlite else Base.metadata.tables:
                connection.exec_driver_sql(f"VACUUM (FULL) {table}")
        self.purge_log()

    def close(self) -> None:
        """Close the connections of this process that are idle."""
        self.engine.dispose()

    @contextlib.contextmanager
    def _turn_of_threads(self) -> Iterator[None]:
        """Hold the turn among the threads of this process; StoreBusy where it does not come."""
        if not self._writing.acquire(timeout=self._timeout):
            raise StoreBusy("other writes of this process take too long")
        try:
            yield
        finally:
            self._writing.release()

    def _turn(self, until: float) -> contextlib.AbstractContextManager[None]:
        """The turn to wait for SQLite's lock; nothing on PostgreSQL."""
        return contextlib.nullcontext() if self._file is None else next_in_line(self._file, until)

    @contextlib.contextmanager
    def _patience(self, connection: Connection, until: float) -> Iterator[Any]:
        """SQLite's driver, which waits for locks until `until` and not for the whole timeout."""
        driver = _driver(connection)
        driver.execute(_busy_timeout(max(0.0, until - time.monotonic())))
        try:
            yield driver
        finally:
            driver.execute(_busy_timeout(self._timeout))

    def _require_file(self) -> None:
        """Refuse to go on with a file that was moved or removed: its writes would go with it."""
        if _identity(self._file) != self._opened:
            raise StoreUnavailable(
                "the database file was removed or replaced while it was open: put it back, or stop "
                "the service first and start it again"
            )


def delete(session: Session, table: type[Base], *conditions: Any) -> int:
    """Delete rows; returns how many."""
    result: Any = session.execute(sa.delete(table.__table__).where(*conditions))  # type: ignore[arg-type]
    return int(result.rowcount)


def _identity(file: Path | None) -> tuple[int, int] | None:
    try:
        status = None if file is None else file.stat()
    except OSError:
        return None
    return None if status is None else (status.st_dev, status.st_ino)


def _busy_timeout(seconds: float) -> str:
    return f"PRAGMA busy_timeout = {round(1000 * seconds)}"


def _driver(connection: Connection) -> Any:
    """The connection below SQLAlchemy's.

    SQLite's BEGIN is said there: as a listener of the engine's, it would make SQLAlchemy call
    listeners around every statement.
    """
    return connection.connection.driver_connection


@contextlib.contextmanager
def _translating() -> Iterator[None]:
    try:
        yield
    except _DATABASE_ERRORS as error:
        raise _translated(error) from None


def _translated(error: Exception) -> StoreError:
    """Say what went wrong without the statement, its parameters or any row."""
    if isinstance(error, PoolTimeout):
        return StoreBusy("all connections to the database are busy")
    lost = isinstance(error, DBAPIError) and error.connection_invalidated
    cause = error.orig if isinstance(error, DBAPIError) else error
    name = type(cause).__name__
    if isinstance(cause, sqlite3.Error):
        return _sqlite_error(cause)
    if isinstance(cause, _POSTGRES):
        state = getattr(cause, "sqlstate", None) or ""
        if state == "42P01":
            return StoreError(_TABLE_MISSING)
        if state == "42703":
            return StoreError(_OTHER_VERSION)
        if state in (_LOCK_NOT_AVAILABLE, _DEADLOCK, _SERIALISATION):
            return StoreBusy("another write, or a command on whole tables, takes too long")
        # The server answers with a state; without one the connection failed.
        unanswered = not state and isinstance(cause, _UNANSWERED)
        if lost or state[:2] in _UNAVAILABLE_CLASSES or unanswered:
            return StoreUnavailable(f"the PostgreSQL server does not answer ({name} {state})")
        return StoreError(f"PostgreSQL refused the statement ({name} {state})")
    if isinstance(cause, OSError):
        return StoreUnavailable(f"the database cannot be reached: {cause.strerror}")
    return StoreError(f"the database cannot be used ({name})")


def _sqlite_error(cause: sqlite3.Error) -> StoreError:
    code = getattr(cause, "sqlite_errorname", "")
    if "no such table" in str(cause):
        return StoreError(_TABLE_MISSING)
    if "no such column" in str(cause) or "has no column" in str(cause):
        return StoreError(_OTHER_VERSION)
    if code.startswith(("SQLITE_CORRUPT", "SQLITE_NOTADB")):
        return StoreUnavailable("the SQLite file is damaged, or is not a database")
    if code.startswith("SQLITE_BUSY"):
        return StoreBusy(f"another write takes too long: {cause}")
    if isinstance(cause, sqlite3.OperationalError):
        # SQLite's own words for a full disk, a lock that was not freed and the like.
        return StoreUnavailable(f"the SQLite database does not answer: {cause}")
    return StoreError(f"SQLite refused the statement ({type(cause).__name__} {code})")
