"""Bringing a database to the schema of this program, and finding out whether it is there."""

import functools
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.database import Database


def upgrade(database: Database) -> None:
    """Migrate to the newest schema. Of several workers that start at once, one migrates.

    Raises
    ------
    StoreError
        If the schema is one that this program does not know. Nothing was changed.
    """

    def work(connection: Connection) -> None:
        present = _revision_of(connection)
        _require_known(present)
        if present != head_revision():
            command.upgrade(_config(connection), "head")

    database.write(work, wait=0)


def current_revision(database: Database) -> str | None:
    """Revision the database is at; None for an empty one."""
    return database.read(_revision_of)


def head_revision() -> str:
    """Revision this program needs."""
    head = _scripts().get_current_head()
    assert head is not None, "the package holds at least one migration"  # noqa: S101
    return head


def check(database: Database) -> None:
    """Raise :class:`StoreError`, naming the remedy, unless the schema is this program's."""
    present = current_revision(database)
    if present is None:
        raise StoreError("the database is empty: run `veilface db upgrade`")
    _require_known(present)
    if present != head_revision():
        raise StoreError(
            f"the database is at schema {present}, this program needs {head_revision()}: "
            "run `veilface db upgrade`"
        )


def _revision_of(connection: Connection) -> str | None:
    return MigrationContext.configure(connection).get_current_revision()


def _require_known(revision: str | None) -> None:
    known = {script.revision for script in _scripts().walk_revisions()}
    if revision is not None and revision not in known:
        raise StoreError(
            f"the database is at schema {revision}, which this program does not know: "
            "another version migrated it, install that one"
        )


@functools.cache
def _scripts() -> ScriptDirectory:
    return ScriptDirectory.from_config(_config(None))


def _config(connection: Connection | None) -> Config:
    config = Config()
    config.set_main_option(
        "script_location", str(Path(__file__).with_name("migrations")).replace("%", "%%")
    )
    config.set_main_option("path_separator", "newline")
    config.attributes["connection"] = connection
    return config
