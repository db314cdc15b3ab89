"""``veilface db``: the schema of the database, and its files."""

import typer

from api.cli.console import emit, message, say
from api.cli.options import STORE, AsJson, takes_settings
from api.opening import open_keyring, open_store
from api.settings import Settings
from templates.errors import VeilfaceError
from templates.store.database import Database
from templates.store.migrate import current_revision, head_revision

app = typer.Typer(no_args_is_help=True)


@app.callback()
def db() -> None:
    """Bring the database's schema up to date, check it, or compact its files."""


@app.command()
@takes_settings(*STORE)
def upgrade(*, settings: Settings, as_json: AsJson = False) -> None:
    """Migrate the database to the schema of this version.

    `serve` does this by itself at its start; run it before, where several machines start at once.
    Safe to run again. Make a backup first.

    Example: `veilface db upgrade --database-url postgresql+psycopg://veilface@localhost/veilface`
    """
    store = open_store(settings, open_keyring(settings))
    try:
        before = _revision(settings)
        store.upgrade()
        after = _revision(settings)
    finally:
        store.close()
    if as_json:
        emit({"before": before, "after": after})
    elif before == after:
        say(f"The schema is up to date: {after}.")
    else:
        say(f"Migrated from {before or 'an empty database'} to {after}.")


@app.command()
@takes_settings(*STORE)
def check(*, settings: Settings, as_json: AsJson = False) -> None:
    """Check that schema and master key are the right ones; exit status 1 where they are not.

    Example: `veilface db check --data-dir veilface-data`
    """
    store = open_store(settings, open_keyring(settings))
    try:
        store.check()
    except VeilfaceError as error:
        if as_json:
            emit({"ok": False, "reason": str(error)})
        message(f"error: {error}")
        raise typer.Exit(1) from None
    finally:
        store.close()
    if as_json:
        emit({"ok": True, "reason": None})
    else:
        say("The database has the right schema, and this is its master key.")


@app.command()
@takes_settings("data_dir", "database_url")
def current(*, settings: Settings, as_json: AsJson = False) -> None:
    """Say which schema the database has, and which one this version needs.

    Example: `veilface db current --json`
    """
    found = _revision(settings)
    needed = head_revision()
    if as_json:
        emit({"current": found, "needed": needed})
    else:
        say(f"The database is at {found or 'no schema yet'}; this version needs {needed}.")


@app.command()
@takes_settings(*STORE)
def compact(*, settings: Settings, as_json: AsJson = False) -> None:
    """Rewrite the database's files, so that no page keeps what was erased.

    On PostgreSQL this is `VACUUM (FULL)` of the tables that hold subject data: remains of erased
    rows go, and each table is locked meanwhile. SQLite overwrites what is erased at once; there
    this is `VACUUM`, which gives free space back. Both need free disk as large as the data, and
    make writes wait: run it when few requests come.

    Example: `veilface db compact --data-dir veilface-data`
    """
    store = open_store(settings, open_keyring(settings))
    try:
        store.check()
        before = store.size()
        store.compact()
        after = store.size()
    finally:
        store.close()
    if as_json:
        emit({"bytes_before": before, "bytes_after": after})
    else:
        say(f"Compacted the database: {before:,} bytes before, {after:,} after.")


def _revision(settings: Settings) -> str | None:
    """Schema that the database is at; None for an empty one. Needs no master key."""
    database = Database(settings.resolved_database_url)
    try:
        return current_revision(database)
    finally:
        database.close()
