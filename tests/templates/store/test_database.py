import contextlib
import socket
import sqlite3
import stat
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa
from sqlalchemy.engine import make_url

from templates.errors import StoreBusy, StoreError, StoreUnavailable
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.schema import TenantRow
from templates.store.turn import next_in_line
from tests.databases import empty_database, execute
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import put


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("mysql://host/name", "not supported"),
        ("nonsense", "cannot be read"),
        ("", "cannot be read"),
        ("sqlite://", "needs a file"),
        ("sqlite:///:memory:", "needs a file"),
        ("sqlite:////no/such/folder/x.db", "No such file"),
    ],
)
def test_a_url_that_cannot_work_is_refused(url: str, message: str) -> None:
    with pytest.raises(StoreError, match=message):
        Database(url)


@pytest.mark.parametrize("driver", ["postgres", "postgresql", "postgresql+psycopg"])
def test_all_spellings_of_postgresql_mean_psycopg(driver: str) -> None:
    database = Database(f"{driver}://somebody:password@127.0.0.1/name")
    assert database.engine.dialect.driver == "psycopg"


def test_sqlite_is_private_durable_and_forgets(tmp_path: Path) -> None:
    path = tmp_path / "veilface.db"
    database = Database(f"sqlite:///{path}")
    pragmas = {
        "journal_mode": "wal",
        "synchronous": 2,  # FULL
        "foreign_keys": 1,
        "secure_delete": 1,
        "temp_store": 2,  # MEMORY
    }
    for name, value in pragmas.items():
        assert execute(database, f"PRAGMA {name}") == [(value,)], name
    execute(database, "CREATE TABLE t (x)")
    for file in tmp_path.iterdir():
        assert stat.S_IMODE(file.stat().st_mode) == 0o600, file
    database.close()


def test_errors_never_quote_a_row(store: TemplateStore, database_url: str) -> None:
    database = Database(database_url)
    tenant = store.tenants.get("default")

    again = sa.insert(TenantRow).values(id=tenant.id, name="secret-name", rotation_epoch=1)
    with pytest.raises(StoreError) as caught:
        execute(database, again)
    assert not isinstance(caught.value, StoreUnavailable)
    for part in ("secret-name", tenant.id, "INSERT"):
        assert part not in str(caught.value)
    assert caught.value.__suppress_context__
    database.close()


def test_a_table_without_a_column_is_of_another_version(store: TemplateStore) -> None:
    execute(store.database, "ALTER TABLE subjects DROP COLUMN photos")
    for work in (lambda: store.subjects.list("default"), lambda: put(store, "ada", b"wire")):
        with pytest.raises(StoreError, match=r"another version.* make it anew") as caught:
            work()
        assert not isinstance(caught.value, StoreUnavailable)


def test_no_server_is_store_unavailable() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    database = Database(f"postgresql://postgres@127.0.0.1:{port}/postgres", timeout=2)
    for use in (database.read, database.write):
        with pytest.raises(StoreUnavailable, match="does not answer"), use() as session:
            session.execute(sa.select(1))


def test_a_database_of_a_server_without_a_locale_is_used(keyring: MasterKeyring) -> None:
    with empty_database("ENCODING 'SQL_ASCII' LOCALE 'C' TEMPLATE template0") as url:
        store = TemplateStore(url, keyring)
        store.upgrade()
        store.tenants.create("acme")
        assert [tenant.name for tenant in store.tenants.all()] == ["acme"]
        store.close()


def test_a_lost_connection_is_replaced(
    postgres_url: str, postgres_database: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(postgres_url, keyring, pool_size=2)
    store.upgrade()
    store.ping()
    with psycopg.connect(postgres_database, autocommit=True) as connection:
        killed = connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE application_name = 'veilface' AND datname = current_database()"
        ).fetchall()
    assert killed
    store.ping()
    store.tenants.create("after")
    store.close()


def test_a_connection_lost_inside_a_write_is_store_unavailable(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(postgres_url, keyring)
    store.upgrade()
    database = Database(postgres_url)

    store.tenants.create("kept")
    with pytest.raises(StoreUnavailable, match="does not answer"):
        execute(database, sa.delete(TenantRow), "SELECT pg_terminate_backend(pg_backend_pid())")
    assert [tenant.name for tenant in store.tenants.all()] == ["kept"]
    database.close()
    store.close()


def with_options(url: str, more: str) -> str:
    made = make_url(url).update_query_dict({"options": f"{make_url(url).query['options']} {more}"})
    return made.render_as_string(hide_password=False)


def test_the_server_gives_up_a_host_that_is_cut_off_or_stopped(
    postgres_url: str, postgres_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def settings(url: str) -> dict[str, str]:
        database = Database(url)
        seen = execute(database, "SELECT name, reset_val FROM pg_settings")
        database.close()
        return dict(seen)

    bounds = {
        "tcp_keepalives_idle": "5",
        "tcp_keepalives_interval": "5",
        "tcp_keepalives_count": "2",
        "tcp_user_timeout": "15000",
        "idle_in_transaction_session_timeout": "60000",
    }
    own = settings(with_options(postgres_url, "-c tcp_user_timeout=9000"))
    assert own.items() >= {**bounds, "tcp_user_timeout": "9000"}.items()
    assert own["search_path"].startswith("test_")
    monkeypatch.setenv("PGOPTIONS", "-c work_mem=5000")
    assert settings(postgres_database).items() >= {**bounds, "work_mem": "5000"}.items()


def test_a_busy_sqlite_file_is_store_unavailable(tmp_path: Path, keyring: MasterKeyring) -> None:
    path = tmp_path / "veilface.db"
    store = TemplateStore(f"sqlite:///{path}", keyring, timeout=0.2)
    store.upgrade()
    holder = sqlite3.connect(path, isolation_level=None)
    holder.execute("BEGIN IMMEDIATE")
    with pytest.raises(StoreUnavailable, match="locked"):
        store.tenants.create("default")
    assert store.tenants.all() == []  # readers are not held up
    assert not store.purge()  # another time
    holder.execute("ROLLBACK")
    holder.close()
    store.tenants.create("default")
    store.close()


def test_a_write_waits_for_its_turn_in_the_process_no_longer_than_the_timeout(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    store = TemplateStore(f"sqlite:///{tmp_path / 'veilface.db'}", keyring, timeout=0.2)
    store.upgrade()

    with store.database.write(), ThreadPoolExecutor(1) as other:
        refused = other.submit(store.tenants.create, "default").exception(PATIENCE_S)
        assert isinstance(refused, StoreUnavailable)
    store.tenants.create("default")
    store.close()


def test_a_write_waits_for_other_processes_once_and_not_for_each_of_their_locks(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    path = tmp_path / "veilface.db"
    store = TemplateStore(f"sqlite:///{path}", keyring, timeout=2.0)
    store.upgrade()

    def seconds_until_refused() -> float:
        began = time.monotonic()
        with pytest.raises(StoreUnavailable):
            store.tenants.create("default")
        return time.monotonic() - began

    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as tool:
        tool.execute("BEGIN IMMEDIATE")
        alone = seconds_until_refused()
        with next_in_line(path, time.monotonic()):
            assert seconds_until_refused() < 1.6 * alone
    assert store.tenants.create("default")
    store.close()


def test_a_write_waits_for_one_that_hangs_no_longer_than_the_timeout(
    postgres_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(postgres_url, keyring, timeout=0.2)
    store.upgrade()
    store.tenants.create("default")
    put(store, "ada", b"wire")
    database = Database(postgres_url)
    with database.write():
        with pytest.raises(StoreBusy, match="too long"):
            put(store, "ada", b"other")
        assert store.subjects.get("default", "ada") is not None
    put(store, "ada", b"other")
    database.close()
    store.close()


def test_nothing_is_written_to_a_file_that_was_removed(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    path, aside = tmp_path / "veilface.db", tmp_path / "aside.db"
    store = TemplateStore(f"sqlite:///{path}", keyring)
    store.upgrade()
    path.rename(aside)
    for replaced in (False, True):
        if replaced:
            path.touch()
        for work in (store.ping, lambda: store.tenants.create("default")):
            with pytest.raises(StoreUnavailable, match="removed or replaced"):
                work()
    aside.rename(path)
    assert store.tenants.create("default")
    store.close()


def test_a_full_disk_is_said_and_harms_nothing(tmp_path: Path, keyring: MasterKeyring) -> None:
    """SQLite's page limit gives the same error as a full disk (SQLITE_FULL)."""
    store = TemplateStore(f"sqlite:///{tmp_path / 'veilface.db'}", keyring, pool_size=1)
    store.upgrade()
    store.tenants.create("default")
    put(store, "first", b"1" * 5000)
    ((pages,),) = execute(store.database, "PRAGMA page_count")
    execute(store.database, f"PRAGMA max_page_count = {pages}")
    with pytest.raises(StoreUnavailable, match="full"):
        put(store, "second", b"2" * 500_000)
    assert store.subjects.get("default", "second") is None
    first = store.subjects.get("default", "first")
    assert first is not None
    assert first.wire == b"1" * 5000
    store.close()
    with sqlite3.connect(tmp_path / "veilface.db") as raw:
        assert raw.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    raw.close()


def test_a_file_that_is_no_database_is_said(tmp_path: Path, keyring: MasterKeyring) -> None:
    path = tmp_path / "veilface.db"
    path.write_bytes(b"This is a letter, not a database. " * 200)
    store = TemplateStore(f"sqlite:///{path}", keyring)
    with pytest.raises(StoreUnavailable, match="not a database"):
        store.check()
    store.close()


def test_all_connections_busy_is_store_unavailable(database_url: str) -> None:
    database = Database(database_url, pool_size=1, max_overflow=0, timeout=0.2)
    with database.read() as session:
        session.execute(sa.select(1))
        with pytest.raises(StoreUnavailable, match="busy"), database.read() as refused:
            refused.execute(sa.select(1))
    database.close()
