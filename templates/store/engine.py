"""What a connection to SQLite or PostgreSQL is made with: the URL, the pool, SQLite's settings."""

import errno
import os
import time
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.engine import URL, Engine, make_url
from sqlalchemy.exc import ArgumentError

from templates.errors import StoreError

_CUT_OFF = {
    "keepalives_idle": 5,
    "keepalives_interval": 5,
    "keepalives_count": 2,
    "tcp_user_timeout": 15_000,
}
"""When a connection to PostgreSQL is given up: 15 s after the last sign of the other end, be it
silent or does it not acknowledge what was sent. In seconds; the last in milliseconds.

The server does the same. A host that is cut off inside a write has locks for which every other host
waits, and by default a server ends its session after two hours.
"""
_STOPPED_S = 60
"""A process that stops inside a write, on a host that can be reached, is ended after this."""


def checked_url(text: str) -> URL:
    """Read a database URL, with the driver that is used; nothing is opened.

    Raises
    ------
    StoreError
        It cannot be read, or names no database that is supported. The text never quotes it: it
        may hold a password.
    """
    try:
        url = make_url(text)
        if not 0 < (url.port or 1) < 2**16:
            raise ValueError
    except (ArgumentError, ValueError):  # the latter of a port that is no number
        raise StoreError(
            "the database URL cannot be read: write sqlite:///path or "
            "postgresql://user@host:port/name, the port as a number up to 65535, and the "
            "characters : / @ [ ] of a password as %3A %2F %40 %5B %5D"
        ) from None
    if url.drivername in ("postgresql", "postgres", "postgresql+psycopg"):
        return url.set(drivername="postgresql+psycopg")
    if url.drivername in ("sqlite", "sqlite+pysqlite"):
        if not url.database or url.database == ":memory:" or url.database.startswith("file:"):
            raise StoreError("SQLite needs a file: write sqlite:///path")
        return url.set(drivername="sqlite+pysqlite")
    raise StoreError(
        f"a database of kind {url.drivername!r} is not supported: use sqlite:// or postgresql://"
    )


def make_engine(url: URL, *, timeout: float, pool_size: int, max_overflow: int) -> Engine:
    """Make an engine; on SQLite a transaction begins where somebody says BEGIN."""
    pool: dict[str, Any] = {
        "pool_size": pool_size,
        "max_overflow": max_overflow,
        "pool_timeout": timeout,
        "hide_parameters": True,  # an error text must never quote a row
    }
    if url.get_backend_name() != "sqlite":
        return sa.create_engine(
            url,
            pool_pre_ping=True,
            # Each statement of a write must see what was committed before its lock was taken.
            isolation_level="READ COMMITTED",
            connect_args={
                "connect_timeout": max(2, round(timeout)),
                "application_name": "veilface",
                # Text would arrive as bytes from a server that was made without a locale.
                "client_encoding": "utf8",
                "options": _session_options(url),
                **_CUT_OFF,
            },
            **pool,
        )
    path = sqlite_file(url)
    _create_private_file(path)
    engine = sa.create_engine(
        url,
        poolclass=sa.pool.QueuePool,
        connect_args={"timeout": timeout, "check_same_thread": False},
        **pool,
    )
    event.listen(engine, "connect", _prepare_sqlite)
    return engine


def _session_options(url: URL) -> str:
    settings = {f"tcp_{name.removeprefix('tcp_')}": value for name, value in _CUT_OFF.items()}
    settings["idle_in_transaction_session_timeout"] = 1000 * _STOPPED_S
    # Of two values the server takes the last one, so an operator's own prevail.
    given = url.normalized_query.get("options", (os.environ.get("PGOPTIONS", ""),))
    return " ".join([*(f"-c {name}={value}" for name, value in settings.items()), *given])


def sqlite_file(url: URL) -> Path:
    """Return the file of an SQLite database; a link to it has been followed."""
    return Path(str(url.database)).resolve()


def _create_private_file(path: Path) -> None:
    # A file that is there is not opened: closing it would drop the locks that SQLite holds on it.
    try:
        if path.exists():
            if not os.access(path, os.R_OK | os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        else:
            os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise StoreError(f"the database file {path} cannot be used: {error.strerror}") from None


def _prepare_sqlite(connection: Any, _record: object) -> None:
    connection.isolation_level = None  # the driver begins none by itself
    cursor = connection.cursor()
    try:
        # Waiting first: the switch to WAL below needs the file for itself for a moment.
        _set_wal(cursor)
        cursor.execute("PRAGMA synchronous = FULL")
        cursor.execute("PRAGMA foreign_keys = ON")
        cursor.execute("PRAGMA secure_delete = ON")
        cursor.execute("PRAGMA temp_store = MEMORY")
    finally:
        cursor.close()


def _set_wal(cursor: Any) -> None:
    # SQLite answers "locked" at once here, without its busy handler, when two processes switch.
    for pause in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, None):
        try:
            (mode,) = cursor.execute("PRAGMA journal_mode = WAL").fetchone()
        except Exception as error:
            if pause is None or "locked" not in str(error):
                raise
            time.sleep(pause)
            continue
        if mode != "wal":
            raise StoreError(
                f"SQLite keeps its journal as {mode!r} here, not as a write-ahead log: "
                "put the database file on a local disk"
            )
        return
