import pytest

from templates.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.migrate import head_revision
from tests.api.cli.conftest import run
from tests.templates.store.conftest import put


def test_upgrade_check_and_current(tmp_path):
    where = ("--data-dir", tmp_path / "new")
    unready = run("db", "check", *where, "--json")
    assert unready.status == 1
    assert "veilface db upgrade" in unready.json["reason"]
    assert run("db", "current", *where, "--json").json == {
        "current": None,
        "needed": head_revision(),
    }
    upgraded = run("db", "upgrade", *where, "--json")
    assert upgraded.json == {"before": None, "after": head_revision()}
    assert "up to date" in run("db", "upgrade", *where).stdout
    assert run("db", "check", *where).status == 0
    assert head_revision() in run("db", "current", *where).stdout


def test_compact_gives_the_space_of_erased_subjects_back(tmp_path):
    where = ("--data-dir", tmp_path)
    refused = run("db", "compact", *where)
    assert refused.status == 1
    assert "veilface db upgrade" in refused.stderr
    assert run("db", "upgrade", *where).status == 0
    store = TemplateStore(
        f"sqlite:///{tmp_path / 'veilface.db'}", MasterKeyring.load(tmp_path / "master.key")
    )
    store.tenants.create("default")
    for number in range(20):
        put(store, f"s{number}", bytes(17_000))
    for number in range(19):
        store.erase("default", f"s{number}")
    before = (tmp_path / "veilface.db").stat().st_size
    ran = run("db", "compact", *where, "--json")
    assert ran.status == 0
    after = (tmp_path / "veilface.db").stat().st_size
    assert ran.json == {"bytes_before": before, "bytes_after": after}
    assert before - after > 18 * 17_000
    kept = store.get("default", "s19")
    assert kept is not None
    assert kept.wire == bytes(17_000)
    store.close()


def test_another_master_key_fails_the_check(tmp_path):
    where = ("--data-dir", tmp_path)
    assert run("db", "upgrade", *where).status == 0
    MasterKeyring.create(tmp_path / "other.key")
    ran = run("db", "check", *where, "--master-key-file", tmp_path / "other.key")
    assert ran.status == 1
    assert "not the master key of this database" in ran.stderr


@pytest.mark.parametrize("command", ["upgrade", "check", "compact", "current"])
def test_a_database_that_does_not_answer_is_a_sentence(tmp_path, command):
    url = "postgresql+psycopg://someone:s3cret@127.0.0.1:1/none"
    ran = run("db", command, "--data-dir", tmp_path, "--database-url", url)
    assert ran.status == 1
    assert ran.stderr.startswith("error: ")
    assert "s3cret" not in ran.stderr
    assert "Traceback" not in ran.stderr
