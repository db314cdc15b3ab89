"""Bringing a database to the schema of this program, and finding out whether it is there."""

from pathlib import Path
from typing import Any

from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy.engine import Connection

from templates.errors import StoreError
from templates.store.database import Database
from templates.store.schema import Base

_LOCK = "veilface schema"


def upgrade(database: Database, revision: str = "head") -> None:
    """Migrate upwards. Of several workers that start at once, one migrates and the rest wait."""
    database.write(
        lambda connection: command.upgrade(_config(connection), revision), lock=_LOCK, wait=0
    )


def downgrade(database: Database, revision: str) -> None:
    """Migrate downwards, to ``"base"`` for an empty database; data of dropped tables goes."""
    database.write(
        lambda connection: command.downgrade(_config(connection), revision), lock=_LOCK, wait=0
    )


def current_revision(database: Database) -> str | None:
    """Revision the database is at; None for an empty one."""
    return database.read(
        lambda connection: MigrationContext.configure(connection).get_current_revision()
    )


def head_revision() -> str:
    """Revision this program needs."""
    head = ScriptDirectory.from_config(_config(None)).get_current_head()
    assert head is not None, "the package holds at least one migration"  # noqa: S101
    return head


def check(database: Database) -> None:
    """Raise :class:`StoreError`, naming the remedy, unless the schema is the one needed."""
    present, needed = current_revision(database), head_revision()
    if present == needed:
        return
    if present is None:
        raise StoreError("the database is empty: run `veilface db upgrade`")
    scripts = ScriptDirectory.from_config(_config(None)).walk_revisions()
    if present not in {script.revision for script in scripts}:
        raise StoreError(
            f"the database is at schema {present}, which this program does not know: "
            "it was migrated by a newer version, install that one"
        )
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


def _config(connection: Connection | None) -> Config:
    config = Config()
    config.set_main_option(
        "script_location", str(Path(__file__).with_name("migrations")).replace("%", "%%")
    )
    config.set_main_option("path_separator", "newline")
    config.attributes["connection"] = connection
    return config
