import threading

import pytest
import sqlalchemy as sa
from alembic.config import Config
from alembic.script import ScriptDirectory

from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore, migrate, verify_audit_log
from templates.store.database import Database
from templates.store.schema import Base
from templates.store.secrets import SecretName
from tests.databases import execute


def tables(database: Database) -> set[str]:
    return set(sa.inspect(database.engine).get_table_names())


def test_upgrade_makes_every_table(database_url: str) -> None:
    database = Database(database_url)
    assert tables(database) == set()
    migrate.upgrade(database)
    assert tables(database) == {*Base.metadata.tables, "alembic_version"}
    assert migrate.current_revision(database) == migrate.head_revision()
    database.close()


def test_workers_that_start_at_once_agree(database_url: str, keyring: MasterKeyring) -> None:
    errors: list[Exception] = []
    tenants: list[str] = []
    secrets: list[bytes] = []
    start = threading.Barrier(6)

    def worker() -> None:
        store = TemplateStore(database_url, keyring)
        start.wait()
        try:
            store.upgrade()
            tenants.append(store.tenants.create("default").id)
            assert verify_audit_log(store).intact
            secrets.append(store.secrets.get(SecretName.PSEUDONYM))
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
    assert len(tenants) == 6
    assert len(set(tenants)) == 1
    assert len(secrets) == 6
    assert len(set(secrets)) == 1


def test_check_names_the_remedy(database_url: str, keyring: MasterKeyring) -> None:
    store = TemplateStore(database_url, keyring)
    with pytest.raises(StoreError, match="veilface db upgrade"):
        store.check()
    store.upgrade()
    store.check()
    database = Database(database_url)
    execute(database, "UPDATE alembic_version SET version_num='9'")
    for call in (store.check, store.upgrade):
        with pytest.raises(StoreError, match="another version migrated it"):
            call()
    database.close()
    store.close()


def test_a_query_before_the_upgrade_names_the_remedy(
    database_url: str, keyring: MasterKeyring
) -> None:
    store = TemplateStore(database_url, keyring)
    with pytest.raises(StoreError, match="veilface db upgrade"):
        store.subjects.get("default", "ada")
    store.close()


def test_files_are_named_by_their_revisions() -> None:
    config = Config()
    config.set_main_option("script_location", str(migrate.MIGRATIONS))
    config.set_main_option("path_separator", "newline")
    scripts = ScriptDirectory.from_config(config).walk_revisions()
    assert tuple(script.revision for script in scripts)[::-1] == migrate.known_revisions()
