"""Bringing a database to the schema of this program, and finding out whether it is there."""

from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from templates.errors import StoreError
from templates.store.database import Database

MIGRATIONS = Path(__file__).with_name("migrations")
_VERSION = sa.table("alembic_version", sa.column("version_num"))


def upgrade(database: Database) -> None:
    """Migrate to the newest schema. Of several workers that start at once, one migrates.

    Raises
    ------
    StoreError
        If the schema is one that this program does not know. Nothing was changed.
    """
    with database.write(timeout=0) as session:
        present = _revision_of(session)
        _require_known(present)
        if present != head_revision():
            _migrate(session)


def current_revision(database: Database) -> str | None:
    """Revision the database is at; None for an empty one."""
    with database.read() as session:
        return _revision_of(session)


def head_revision() -> str:
    """Revision this program needs."""
    return known_revisions()[-1]


def known_revisions() -> tuple[str, ...]:
    """Revisions that this program brings, the oldest first: file ``0001_….py`` has ``0001``."""
    scripts = (MIGRATIONS / "versions").glob("[0-9]*.py")
    return tuple(sorted(script.stem.split("_")[0] for script in scripts))


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


def _revision_of(session: Session) -> str | None:
    if not sa.inspect(session.connection()).has_table(_VERSION.name):
        return None
    return session.scalar(sa.select(_VERSION.c.version_num))


def _require_known(revision: str | None) -> None:
    if revision is not None and revision not in known_revisions():
        raise StoreError(
            f"the database is at schema {revision}, which this program does not know: "
            "another version migrated it, install that one"
        )


def _migrate(session: Session) -> None:
    # Imported here: a worker that finds the right schema does without, and its 11 MB.
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "newline")
    config.attributes["connection"] = session.connection()
    command.upgrade(config, "head")
