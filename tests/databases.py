"""Fixtures for the databases that tests run on: SQLite in a folder, and a real PostgreSQL server.

``VEILFACE_TEST_POSTGRES_URL`` names the server; without it, a server on this machine is tried.
Tests make a database of a random name there and drop it. Where no server answers they skip, unless
``VEILFACE_REQUIRE_POSTGRES=1`` says that this is a failure.

A ``conftest.py`` imports the fixtures it needs::

    from tests.databases import database_url, postgres_database, postgres_url  # noqa: F401
"""

import functools
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import pytest
import sqlalchemy as sa
from sqlalchemy.engine import make_url

from templates.store import migrate
from templates.store.database import Database
from tests.required import absent

DEFAULT_SERVER = "postgresql://postgres@127.0.0.1:5432/postgres"


def postgres_server() -> str:
    """URL of the server that tests may make databases on."""
    server = os.environ.get("VEILFACE_TEST_POSTGRES_URL", DEFAULT_SERVER)
    return server.replace("postgresql+psycopg://", "postgresql://")


@contextmanager
def empty_database(options: str = "") -> Iterator[str]:
    """Make a database on the server, and drop it after the block; gives its URL.

    ``options`` are those of ``CREATE DATABASE``.
    """
    server = postgres_server()
    try:
        connection = psycopg.connect(server, autocommit=True, connect_timeout=3)
    except psycopg.OperationalError as error:
        reason = f"no PostgreSQL server answers ({type(error).__name__})"
        absent(reason, "VEILFACE_REQUIRE_POSTGRES")
    name = f"veilface_test_{secrets.token_hex(6)}"
    with connection:
        connection.execute(f'CREATE DATABASE "{name}" {options}')
        # Tests kill clients, never the server: no need to wait for its disk.
        connection.execute(f'ALTER DATABASE "{name}" SET synchronous_commit TO off')
        yield make_url(server).set(database=name).render_as_string(hide_password=False)
        connection.execute(f'DROP DATABASE "{name}" WITH (FORCE)')


@pytest.fixture(scope="session")
def postgres_database() -> Iterator[str]:
    """URL of an empty database of this test run's own."""
    with empty_database() as url:
        yield url


@pytest.fixture
def postgres_url(postgres_database: str) -> Iterator[str]:
    """URL of an empty schema of this test's own."""
    schema = f"test_{secrets.token_hex(6)}"
    with psycopg.connect(postgres_database, autocommit=True) as connection:
        connection.execute(f'CREATE SCHEMA "{schema}"')
    url = make_url(postgres_database).update_query_dict({"options": f"-csearch_path={schema}"})
    yield url.render_as_string(hide_password=False)
    with psycopg.connect(postgres_database, autocommit=True) as connection:
        connection.execute("SET client_min_messages = warning")
        connection.execute(f'DROP SCHEMA "{schema}" CASCADE')


@pytest.fixture(params=["sqlite", "postgres"])
def database_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database: each test runs on SQLite and again on PostgreSQL."""
    return url_of(request, tmp_path)


def url_of(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """URL of an empty database of the kind that the fixture's parameter names."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'veilface.db'}"
    url: str = request.getfixturevalue("postgres_url")
    return url


def migrate_ahead(url: str) -> None:
    """Give an empty database the tables of this program, as its migrations make them.

    Its upgrade then finds nothing to do; the migrations take longer than most tests of the store.
    """
    database = make_url(url)
    if database.get_backend_name() == "postgresql":
        with psycopg.connect(url, autocommit=True) as connection:
            connection.execute(_statements())
    elif database.database is not None:
        path = Path(database.database)
        path.touch(0o600, exist_ok=False)
        path.write_bytes(_migrated())


def execute(database: Database, *statements: Any, **values: object) -> list[Any]:
    """Run statements in one write, as an attacker or another program; the last one's rows."""
    with database.write() as session:
        for statement in statements:
            text = sa.text(statement) if isinstance(statement, str) else statement
            result: Any = session.execute(text, values)
        return list(result) if getattr(result, "returns_rows", True) else []


@functools.cache
def _migrated() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "migrated.db"
        database = Database(f"sqlite:///{file}")
        migrate.upgrade(database)
        database.close()
        assert {path.name for path in Path(folder).iterdir()} == {file.name, f"{file.name}-turn"}
        return file.read_bytes()


@functools.cache
def _statements() -> bytes:
    """What the migrations ask of PostgreSQL, to be asked at once."""
    asked: list[str] = []

    def note(_: Any, cursor: Any, statement: str, parameters: Any, *__: Any) -> None:
        if not statement.startswith("SELECT"):
            asked.append(psycopg.ClientCursor(cursor.connection).mogrify(statement, parameters))

    with empty_database() as url:
        database = Database(url)
        sa.event.listen(database.engine, "before_cursor_execute", note)
        migrate.upgrade(database)
        database.close()
    return ";".join(asked).encode()
