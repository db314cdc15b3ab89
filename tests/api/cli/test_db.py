import base64
import json
import sqlite3
from types import SimpleNamespace

import pytest

from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store.audit_log import By
from templates.store.lockout import LockedOut
from templates.store.migrate import head_revision
from tests.api.cli.conftest import key_file, run
from tests.templates.store.conftest import put


def test_upgrade_and_check(tmp_path):
    where = ("--data-dir", tmp_path / "new")
    unready = run("db", "check", *where, "--json")
    assert unready.status == 1
    assert "veilface db upgrade" in unready.json["reason"]
    assert (unready.json["current"], unready.json["needed"]) == (None, head_revision())
    upgraded = run("db", "upgrade", *where, "--json")
    assert upgraded.json == {
        "before": None,
        "after": head_revision(),
    }
    assert run("db", "upgrade", *where).stdout.count(head_revision()) == 2
    assert run("db", "compact", *where, "--json").json == {"compacted": True}
    checked = run("db", "check", *where, "--json")
    assert (checked.status, checked.json["current"]) == (0, head_revision())


def test_enrollment_by_template_is_off_until_it_is_allowed(tmp_path):
    where = ("--data-dir", tmp_path)
    assert run("db", "upgrade", *where).status == 0
    unknown = run("db", "template-enrollment", *where)
    assert unknown.status == 1
    assert "there is no tenant" in unknown.stderr
    made = run("keys", "create", *where, "--tenant", "acme", "--right", "enroll")
    assert made.status == 0
    acme = ("db", "template-enrollment", *where, "--tenant", "acme")
    assert run(*acme, "--json").json == {"tenant": "acme", "template_enrollment": False}
    assert run(*acme, "--allow", "--json").json == {"tenant": "acme", "template_enrollment": True}
    assert "template enrollment: yes" in run(*acme).stdout
    assert "template enrollment: no" in run(*acme, "--forbid").stdout
    assert run(*acme, "--json").json["template_enrollment"] is False
    log = [json.loads(line) for line in run("audit-log", "show", *where).stdout.splitlines()]
    outcomes = [line["outcome"] for line in log if line["action"] == "tenant-settings"]
    assert outcomes == ["template-enrollment-on", "template-enrollment-off"]


@pytest.mark.parametrize("command", ["upgrade", "check", "compact"])
def test_a_database_that_does_not_answer_is_a_sentence(tmp_path, command):
    url = "postgresql+psycopg://someone:s3cret@127.0.0.1:1/none"
    ran = run("db", command, "--data-dir", tmp_path, "--database-url", url)
    assert ran.status == 1
    assert ran.stderr.startswith("error: ")
    assert "s3cret" not in ran.stderr


def test_a_check_of_a_damaged_database_is_told_as_json(tmp_path):
    where = ("--data-dir", tmp_path)
    assert run("db", "upgrade", *where).status == 0
    (tmp_path / "veilface.db").write_bytes(b"damaged" * 1000)
    ran = run("db", "check", *where, "--json")
    assert (ran.status, ran.json["ok"], ran.json["current"]) == (1, False, None)
    assert ran.json["reason"]


@pytest.fixture
def opened(tmp_path):
    """A store with the tenants default and acme, and the flag that leads there."""
    where = ("--data-dir", tmp_path)
    assert run("db", "upgrade", *where).status == 0
    store = TemplateStore(
        f"sqlite:///{tmp_path / 'veilface.db'}", MasterKeyring.load(key_file(tmp_path))
    )
    for name in ("default", "acme"):
        store.tenants.create(name)
    yield store, where
    store.close()


def reject(store, subject, tenant="default"):
    decided = SimpleNamespace(accepted=False, level="x")
    store.attempts.decide(tenant, subject, lambda _: decided, contract_id="c" * 64, by=By())


def test_unlock_forgets_failures(opened):
    store, where = opened
    for _ in range(5):
        reject(store, "ann")
    with pytest.raises(LockedOut):
        reject(store, "ann")
    ran = run("db", "unlock", "ann", *where, "--json")
    assert (ran.status, ran.json["lifted"]) == (0, True)
    reject(store, "ann")
    assert run("db", "unlock", "ann", *where).status == 0
    again = run("db", "unlock", "ann", *where)
    assert again.status == 1
    assert "no failed attempts" in again.stderr


def test_purge_erases_who_is_due(opened):
    store, where = opened
    for subject in ("old", "new"):
        put(store, subject, bytes(100))
    with sqlite3.connect(where[1] / "veilface.db") as connection:
        connection.execute(
            "UPDATE subjects SET updated_at = '2020-01-01 00:00:00.000000' WHERE subject_id = 'old'"
        )
    connection.close()
    keep = ("--retention-days", "30", *where, "--json")
    assert run("db", "purge", *where, "--json").json == {"due": 0, "erased": 0, "log_purged": True}
    assert run("db", "purge", "--dry-run", *keep).json == {
        "due": 1,
        "erased": 0,
        "log_purged": True,
    }
    assert store.subjects.describe("default", "old") is not None
    assert run("db", "purge", *keep).json == {"due": 1, "erased": 1, "log_purged": True}
    assert store.subjects.describe("default", "old") is None
    assert store.subjects.describe("default", "new") is not None
    assert store.erasures.receipt("default", "old") is not None


def test_a_tenant_is_erased_with_a_receipt(opened, tmp_path):
    store, where = opened
    for subject in ("a", "b"):
        put(store, subject, bytes(100), tenant="acme")
    put(store, "a", bytes(100))
    token = store.api_keys.create("acme", ["verify"]).token
    unsure = run("db", "erase-tenant", "acme", "--confirm", "acmf", *where)
    assert unsure.status == 2
    assert store.subjects.describe("acme", "a") is not None
    receipt = tmp_path / "receipt.json"
    ran = run("db", "erase-tenant", "acme", "--confirm", "acme", "--out", receipt, *where)
    assert ran.status == 0, ran.stderr
    assert "acme" in ran.stdout
    assert store.api_keys.verify(token) is None
    assert "acme" not in [tenant.name for tenant in store.tenants.all()]
    assert store.subjects.describe("default", "a") is not None
    key = base64.b64encode(store.signer.public_key()).decode()
    checked = run("keys", "verify-receipt", receipt, "--public-key", key)
    assert checked.status == 0, checked.stderr
    assert "claims tenant: acme" in checked.stdout
    missing = run("db", "erase-tenant", "nobody", "--confirm", "nobody", *where)
    assert missing.status == 1
