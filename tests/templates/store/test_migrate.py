import logging
import operator
import re
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa

from templates.errors import SealError, StoreBusy, StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import Retention, TemplateStore, migrate
from templates.store.database import Database
from templates.store.migrations import NEWEST, number_of, oldest_served
from templates.store.schema import Base, SubjectRow, TenantRow
from templates.store.secret import SecretName
from tests.templates.store.conftest import put


def tables(database: Database) -> set[str]:
    return set(sa.inspect(database.engine).get_table_names())


def test_upgrade_from_empty_gives_what_the_mapped_classes_say(database_url: str) -> None:
    database = Database(database_url)
    assert tables(database) == set()
    migrate.upgrade(database)
    assert migrate.differences(database) == []
    assert tables(database) == {*Base.metadata.tables, "alembic_version"}
    assert migrate.current_revision(database) == migrate.head_revision()
    database.close()


def test_a_difference_would_be_seen(database_url: str) -> None:
    database = Database(database_url)
    migrate.upgrade(database)
    database.write(lambda each: each.exec_driver_sql("DROP TABLE audit_log"))
    database.write(lambda each: each.exec_driver_sql("ALTER TABLE receipts ADD COLUMN more TEXT"))
    kinds = {difference[0] for difference in migrate.differences(database)}
    assert {"add_table", "remove_column"} <= kinds
    database.close()


def test_each_migration_can_be_taken_back(database_url: str) -> None:
    database = Database(database_url)
    migrate.upgrade(database)
    migrate.downgrade(database, "base")
    assert tables(database) == {"alembic_version"}
    migrate.upgrade(database)
    assert migrate.differences(database) == []
    database.close()


def test_who_is_enrolled_at_the_upgrade_is_not_taken_for_unused(
    database_url: str, keyring: MasterKeyring
) -> None:
    """No use was noted before: a retention of unused subjects begins to count at the upgrade."""
    database = Database(database_url)
    migrate.upgrade(database, "0001")
    now = datetime.now(UTC)
    long_ago = now - timedelta(days=3650)
    tenant = sa.insert(TenantRow).values(
        id="t", name="default", rotation_epoch=1, created_at=long_ago
    )
    subjects = sa.insert(SubjectRow).values(
        [
            {
                "id": name,
                "tenant_id": "t",
                "subject_id": name,
                "wrapped_key": b"w",
                "wrapping_key": "k",
                "created_at": long_ago,
                "updated_at": long_ago,
            }
            for name in ("ada", "eve")
        ]
    )
    for statement in (tenant, subjects):
        database.write(lambda each, run=statement: each.execute(run))
    store = TemplateStore(database_url, keyring)
    store.upgrade()
    disuse = Retention(max_disuse=timedelta(days=1))
    assert store.retention.due(disuse) == 0
    assert store.retention.erase_expired(disuse) == 0
    assert store.retention.due(Retention(max_age=timedelta(days=3649))) == 2
    used = database.read(lambda each: each.execute(sa.select(SubjectRow.last_used_at)).all())
    assert len(used) == 2
    assert all(now <= at <= datetime.now(UTC) for (at,) in used)
    # It counts from there on, in the format that the column has: two days later they are due.
    later = TemplateStore(database_url, keyring, clock=lambda: now + timedelta(days=2))
    assert later.retention.due(disuse) == 2
    assert later.retention.due(Retention(max_disuse=timedelta(days=3))) == 0
    for each in (later, store, database):
        each.close()


def test_a_schema_with_lines_in_the_audit_log_is_not_taken_back(store: TemplateStore) -> None:
    """Its head would begin again at 0, and the next line have the number of the first."""
    put(store, "ada", b"wire")
    with pytest.raises(StoreError, match="the audit log has lines"):
        migrate.downgrade(store.database, "0001")
    store.check()
    put(store, "eve", b"wire")
    assert store.audit_log.verify().intact


def test_a_schema_that_was_taken_back_begins_the_audit_log_anew(
    database_url: str, keyring: MasterKeyring
) -> None:
    for _ in range(2):
        store = TemplateStore(database_url, keyring)
        store.upgrade()
        assert store.audit_log.verify().intact
        migrate.downgrade(store.database, "0001")
        store.close()


def test_upgrading_twice_keeps_the_data(store: TemplateStore) -> None:
    put(store, "ada", b"wire")
    store.upgrade()
    found = store.subjects.get("default", "ada")
    assert found is not None
    assert found.wire == b"wire"


def test_workers_that_start_at_once_agree(database_url: str, keyring: MasterKeyring) -> None:
    errors: list[Exception] = []
    tokens: list[str] = []
    secrets: list[bytes] = []
    start = threading.Barrier(6)

    def worker() -> None:
        store = TemplateStore(database_url, keyring)
        start.wait()
        try:
            store.upgrade()
            if new := store.api_keys.bootstrap():
                tokens.append(new.token)
            assert store.audit_log.verify().intact
            secrets.append(store.secrets.get(SecretName.PSEUDONYM).value)
        except Exception as error:
            errors.append(error)
        finally:
            store.close()

    threads = [threading.Thread(target=worker) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []
    assert len(tokens) == 1
    assert len(secrets) == 6
    assert len(set(secrets)) == 1


def test_check_names_the_remedy(database_url: str, keyring: MasterKeyring) -> None:
    store = TemplateStore(database_url, keyring)
    with pytest.raises(StoreError, match="veilface db upgrade"):
        store.check()
    store.upgrade()
    store.check()
    database = Database(database_url)
    database.write(lambda each: each.exec_driver_sql("UPDATE alembic_version SET version_num='9'"))
    with pytest.raises(StoreError, match="newer version"):
        store.check()
    database.close()
    store.close()


def of_schema(database_url: str, revision: str) -> Database:
    """A database that says that it is at a revision, without its changes."""
    database = Database(database_url)
    statement = sa.text("UPDATE alembic_version SET version_num = :revision")
    database.write(lambda connection: connection.execute(statement, {"revision": revision}))
    return database


def test_a_later_schema_is_used_where_it_says_that_it_serves_this_version(
    database_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(database_url, keyring)
    store.upgrade()
    after, later = f"{int(NEWEST) + 1:04}", f"{int(NEWEST) + 2:04}"
    for served in (f"{after}_serves_{NEWEST}", f"{later}_serves_0001"):
        database = of_schema(database_url, served)
        store.check()
        store.upgrade()
        assert migrate.current_revision(database) == served
        database.close()
    for other in (after, f"{later}_serves_{after}", f"{after}_serves_", "9"):
        database = of_schema(database_url, other)
        for call in (store.check, store.upgrade):
            with pytest.raises(StoreError, match="newer version"):
                call()
        database.close()
    store.close()


def test_an_unknown_schema_that_is_not_later_is_refused(
    database_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(database_url, keyring)
    store.upgrade()
    for other in (f"{NEWEST}_other", f"{NEWEST}_serves_0001", "0003x", "0007_b"):
        database = of_schema(database_url, other)
        for call in (store.check, store.upgrade):
            with pytest.raises(StoreError, match=f"{other}, .* migrated by another program"):
                call()
        database.close()
    store.close()


@pytest.mark.parametrize("name", ["veilface 0007", "veilface 0007 - 10.0.0.9:5432", "veilface"])
def test_no_migration_under_a_version_that_it_does_not_serve(
    postgres_url: str, keyring: MasterKeyring, name: str
) -> None:
    database = Database(postgres_url)
    migrate.upgrade(database, "0007")
    store = TemplateStore(postgres_url, keyring)
    with psycopg.connect(postgres_url, application_name=name):
        with pytest.raises(StoreError, match=r"\(schema (0007|unnamed)\) use the database"):
            store.upgrade()
        assert migrate.current_revision(database) == "0007"
    store.close()
    database.close()


@pytest.mark.parametrize("name", [f"veilface {NEWEST}", "psql", "veilfaceish 0007", ""])
def test_a_migration_beside_whom_it_serves_or_does_not_concern(
    postgres_url: str, keyring: MasterKeyring, name: str
) -> None:
    database = Database(postgres_url)
    migrate.upgrade(database, "0007")
    store = TemplateStore(postgres_url, keyring)
    with psycopg.connect(postgres_url, application_name=name):
        store.upgrade()
        assert migrate.current_revision(database) == migrate.head_revision()
    store.close()
    database.close()


def test_a_migration_beside_an_earlier_version_that_it_serves(
    postgres_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = Database(postgres_url)
    migrate.upgrade(database, "0007")
    monkeypatch.setattr(migrate, "oldest_served", lambda revision: "0007")
    with psycopg.connect(postgres_url, application_name="veilface 0007"):
        migrate.upgrade(database)
        assert migrate.current_revision(database) == migrate.head_revision()
    database.close()


def test_a_migration_gives_up_on_a_table_that_is_held(
    postgres_url: str, keyring: MasterKeyring, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind it would wait everybody else who reads or writes the table."""
    database = Database(postgres_url)
    migrate.upgrade(database, "0006")
    monkeypatch.setattr(migrate, "_TABLE_WAIT_S", 0.1)
    with psycopg.connect(postgres_url) as backup:
        backup.execute("LOCK TABLE api_keys IN ACCESS SHARE MODE")
        for call in (migrate.upgrade, lambda each: migrate.downgrade(each, "0001")):
            with pytest.raises(StoreBusy, match=r"such as a backup .* then try again"):
                call(database)
            assert migrate.current_revision(database) == "0006"
        keys = sa.text("SELECT count(*) FROM api_keys")
        assert database.read(lambda each: each.execute(keys).scalar_one()) == 0
        columns = {each["name"] for each in sa.inspect(database.engine).get_columns("api_keys")}
        assert "liveness" not in columns
    migrate.upgrade(database)
    assert migrate.current_revision(database) == migrate.head_revision()
    database.close()


def test_no_revision_serves_a_version_that_one_before_does_not() -> None:
    files = Path(migrate.__file__).parent.glob("migrations/versions/[0-9]*.py")
    texts = [path.read_text(encoding="utf-8") for path in sorted(files)]
    revisions = [re.findall(r'^revision = "(\w+)"$', text, re.M)[0] for text in texts]
    oldest = [oldest_served(revision) for revision in revisions]
    assert oldest == sorted(oldest)
    assert all(map(operator.le, oldest, map(number_of, revisions)))
    assert number_of(migrate.head_revision()) == NEWEST == number_of(revisions[-1])


def test_a_query_before_the_upgrade_names_the_remedy(
    database_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(database_url, keyring)
    with pytest.raises(StoreError, match="veilface db upgrade"):
        store.subjects.get("default", "ada")
    store.close()


def test_another_master_key_is_refused_at_the_start(
    store: TemplateStore, database_url: str, tmp_path: Path
) -> None:
    stranger = TemplateStore(database_url, MasterKeyring.create(tmp_path / "other.key"))
    with pytest.raises(SealError, match="not the master key of this database"):
        stranger.check()
    with pytest.raises(SealError, match="not the master key of this database"):
        stranger.upgrade()
    stranger.close()
    store.check()


def test_migrating_leaves_logging_alone(database_url: str) -> None:
    level, handlers = logging.root.level, list(logging.root.handlers)
    database = Database(database_url)
    migrate.upgrade(database)
    assert (logging.root.level, logging.root.handlers) == (level, handlers)
    assert not logging.getLogger("templates").disabled
    database.close()


def test_templates_that_need_a_key_keep_the_schema(store: TemplateStore) -> None:
    """An earlier version would compare them without the holder's rotation, and never match."""
    put(store, "ada", b"wire", holder_salt="ab" * 16)
    with pytest.raises(StoreError, match="1 templates need their holder's key"):
        migrate.downgrade(store.database, "0004")
    store.check()
    put(store, "ada", b"wire")
    migrate.downgrade(store.database, "0004")
    store.upgrade()
    assert store.audit_log.verify().intact
    template = store.subjects.get("default", "ada")
    assert template is not None
    assert (template.wire, template.holder_salt) == (b"wire", None)
