"""Bringing a database to the schema of this program, and finding out whether it is there."""

import contextlib
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy.engine import Connection
from sqlalchemy.exc import OperationalError

from templates.errors import StoreBusy, StoreError
from templates.store.database import Database
from templates.store.engine import APPLICATION
from templates.store.migrations import NEWEST, number_of, oldest_served
from templates.store.schema import Base

_LOCK = "veilface schema"
_TABLE_WAIT_S = 5.0
_LOCK_NOT_AVAILABLE = "55P03"


def upgrade(database: Database, revision: str = "head") -> None:
    """Migrate upwards. Of several workers that start at once, one migrates and the rest wait.

    Nothing is done to the schema of a later version, where it serves this one too.

    Raises
    ------
    StoreError
        If the schema is of a later version and does not serve this one, or if processes of an
        earlier version are connected that the new schema would not serve. (PostgreSQL only; on
        SQLite they are not seen.)
    StoreBusy
        If another session, such as a backup, holds a table for more than five seconds. Nothing
        was changed. (PostgreSQL only.)
    """

    def work(connection: Connection) -> None:
        present = _revision_of(connection)
        if present is not None and not _is_known(present):
            _require_served(present)
            return
        target = head_revision() if revision == "head" else revision
        if present == target:
            return
        if not database.is_sqlite and present is not None:
            _require_nobody_before(connection, target)
        with _short_waits(database, connection):
            command.upgrade(_config(connection), revision)

    database.write(work, lock=_LOCK, wait=0)


def current_revision(database: Database) -> str | None:
    """Revision the database is at; None for an empty one."""
    return database.read(_revision_of)


def head_revision() -> str:
    """Revision this program needs."""
    head = _scripts().get_current_head()
    assert head is not None, "the package holds at least one migration"  # noqa: S101
    return head


def check(database: Database) -> None:
    """Raise :class:`StoreError`, naming the remedy, unless the schema serves this program."""
    present, needed = current_revision(database), head_revision()
    if present == needed:
        return
    if present is None:
        raise StoreError("the database is empty: run `veilface db upgrade`")
    if not _is_known(present):
        _require_served(present)
        return
    raise StoreError(
        f"the database is at schema {present}, this program needs {needed}: "
        "run `veilface db upgrade`"
    )


def differences(database: Database) -> list[Any]:
    """What the tables of the database and the mapped classes do not agree on."""
    return database.read(
        lambda connection: compare_metadata(
            MigrationContext.configure(connection, opts={"compare_server_default": True}),
            Base.metadata,
        )
    )


def _revision_of(connection: Connection) -> str | None:
    return MigrationContext.configure(connection).get_current_revision()


def _is_known(revision: str) -> bool:
    return revision in {script.revision for script in _scripts().walk_revisions()}


@functools.cache
def _scripts() -> ScriptDirectory:
    """The migrations of this program; each is compiled when they are read."""
    return ScriptDirectory.from_config(_config(None))


def _require_served(later: str) -> None:
    """Refuse an unknown schema, unless it is a later one and says that it serves this program."""
    if number_of(later) <= NEWEST:
        raise StoreError(
            f"the database is at schema {later}, which this program does not know and which is no "
            "later one: it was migrated by another program, install that one"
        )
    if oldest_served(later) > NEWEST:
        raise StoreError(
            f"the database is at schema {later}, which this program does not know: "
            "it was migrated by a newer version, install that one"
        )


def _require_nobody_before(connection: Connection, target: str) -> None:
    """Refuse to migrate under the sessions of programs that the new schema would not serve."""
    query = sa.text(
        "SELECT DISTINCT application_name FROM pg_stat_activity WHERE datname = current_database()"
    )
    names = (str(name).split() for name in connection.execute(query).scalars())
    # A pooler may add words of its own, and the first programs named no number.
    connected = {(words[1:] or [""])[0] for words in names if words[:1] == [APPLICATION]}
    if refused := sorted(number for number in connected if number < oldest_served(target)):
        raise StoreError(
            f"processes of an earlier version (schema {refused[0] or 'unnamed'}) use the "
            f"database, and could not on schema {target}: stop them, then run `veilface db upgrade`"
        )


@contextlib.contextmanager
def _short_waits(database: Database, connection: Connection) -> Iterator[None]:
    """Give up on a table that another session holds: whoever comes for it waits behind us."""
    if database.is_sqlite:
        yield
        return
    limit = f"{round(1000 * _TABLE_WAIT_S)}"
    connection.execute(sa.select(sa.func.set_config("lock_timeout", limit, True)))
    try:
        yield
    except OperationalError as error:
        if getattr(error.orig, "sqlstate", None) != _LOCK_NOT_AVAILABLE:
            raise
        raise StoreBusy(
            f"another session holds a table that the migration changes for more than "
            f"{_TABLE_WAIT_S:g} s, such as a backup or a long query (pg_stat_activity names it), "
            "and nothing was changed: let it end, then try again"
        ) from None


def _config(connection: Connection | None) -> Config:
    config = Config()
    config.set_main_option(
        "script_location", str(Path(__file__).with_name("migrations")).replace("%", "%%")
    )
    config.set_main_option("path_separator", "newline")
    config.attributes["connection"] = connection
    return config
