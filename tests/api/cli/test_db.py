import pytest

from templates.sealing import MasterKeyring
from templates.store.migrate import head_revision
from tests.api.cli.conftest import run


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


def test_another_master_key_fails_the_check(tmp_path):
    where = ("--data-dir", tmp_path)
    assert run("db", "upgrade", *where).status == 0
    MasterKeyring.create(tmp_path / "other.key")
    ran = run("db", "check", *where, "--master-key-file", tmp_path / "other.key")
    assert ran.status == 1
    assert "not the master key of this database" in ran.stderr


@pytest.mark.parametrize("command", ["upgrade", "check", "current"])
def test_a_database_that_does_not_answer_is_a_sentence(tmp_path, command):
    url = "postgresql+psycopg://someone:s3cret@127.0.0.1:1/none"
    ran = run("db", command, "--data-dir", tmp_path, "--database-url", url)
    assert ran.status == 1
    assert ran.stderr.startswith("error: ")
    assert "s3cret" not in ran.stderr
    assert "Traceback" not in ran.stderr
