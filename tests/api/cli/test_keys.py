import base64
import json
import stat

import pytest

from api.opening import file_sealer
from api.receipts import receipt_json
from templates.contract import Contract
from templates.sealing import MasterKeyring
from templates.store import TemplateStore
from tests.api.cli.conftest import run


@pytest.fixture
def store(data):
    opened = TemplateStore(
        f"sqlite:///{data / 'veilface.db'}", MasterKeyring.load(data / "master.key")
    )
    opened.upgrade()
    yield opened
    opened.close()


def test_a_key_is_made_listed_and_revoked(veilface, store):
    made = veilface(
        *("keys", "create", "--right", "enroll", "--right", "verify"),
        *("--label", "shop", "--days", "30", "--json"),
    )
    assert made.status == 0, made.stderr
    token, prefix = made.json["token"], made.json["prefix"]
    found = store.api_keys.verify(token)
    assert found is not None
    assert sorted(found.rights) == ["enroll", "verify"]

    listed = veilface("keys", "list", "--json")
    assert [(key["prefix"], key["label"]) for key in listed.json] == [(prefix, "shop")]
    assert token not in listed.stdout
    assert prefix in veilface("keys", "list").stdout

    assert veilface("keys", "revoke", prefix).status == 0
    assert store.api_keys.verify(token) is None
    again = veilface("keys", "revoke", prefix, "--json")
    assert again.status == 1
    assert again.json == {"prefix": prefix, "revoked": False}
    assert "revoked" in veilface("keys", "list").stdout


def test_the_token_alone_is_on_stdout(veilface):
    made = veilface("keys", "create", "--right", "verify", "--tenant", "new-tenant")
    assert made.status == 0
    assert made.stdout.startswith("vf_")
    assert len(made.stdout.split()) == 1
    assert "new-tenant" in made.stderr


def test_a_key_needs_rights_that_exist(veilface):
    assert veilface("keys", "create").status == 2
    assert veilface("keys", "create", "--right", "everything").status == 2


def test_the_master_key_is_made_once(tmp_path):
    file = tmp_path / "deep" / "key"
    made = run("keys", "master", "--master-key-file", file, "--json")
    assert made.status == 0, made.stderr
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    before = file.read_bytes()
    assert base64.b64encode(base64.b64decode(before)).strip() == before.strip()
    assert before.decode().strip() not in made.stdout
    again = run("keys", "master", "--master-key-file", file)
    assert again.status == 1
    assert "exists already" in again.stderr
    assert file.read_bytes() == before


def test_rotation_wraps_everything_again_and_retires_the_old_key(world, veilface, data):
    photos = world.photos(1, range(3))
    assert veilface("enroll", "ann", *photos, "--pack", world.pack).status == 0
    old = (data / "master.key").read_text()
    ran = veilface("keys", "rotate", "--retire", "--json")
    assert ran.status == 0, ran.stderr
    assert ran.json["rewrapped"] >= 3
    assert ran.json["retired"] == 1
    assert [name.rsplit("/", 1)[-1] for name in ran.json["resealed_files"]] == ["contract.json"]
    new = (data / "master.key").read_text()
    assert len(new.split()) == 1
    assert new != old
    Contract.load(data / "contract.json", file_sealer(MasterKeyring.load(data / "master.key")))
    probe = world.photos(1, range(3, 4))
    assert veilface("verify", "ann", *probe, "--pack", world.pack).status == 0
    again = veilface("keys", "rewrap", "--json")
    assert again.json["rewrapped"] == 0


def test_a_rotation_without_retiring_keeps_both_keys(veilface, data):
    ran = veilface("keys", "rotate")
    assert ran.status == 0, ran.stderr
    assert "--retire" in ran.stdout
    assert len((data / "master.key").read_text().split()) == 2


def test_a_receipt_is_verified_and_a_changed_one_is_not(store, tmp_path):
    store.tenants.create("default")
    answer = receipt_json(store.erase("default", "ann").receipt)
    receipt, contract = tmp_path / "receipt.json", tmp_path / "contract.json"
    key = base64.b64encode(store.receipt_public_key()).decode()
    receipt.write_text(json.dumps({**answer, "request_id": "x"}))
    contract.write_text(json.dumps({"receipt_key": {"public_key": key}}))
    for public in (key, contract):
        ran = run("keys", "verify-receipt", receipt, "--public-key", public, "--json")
        assert ran.status == 0, ran.stderr
        assert ran.json["claims"]["held"] is False
        assert ran.json["claims"]["subject"] == store.pseudonym("default", "ann")
    assert "Valid" in run("keys", "verify-receipt", receipt, "--public-key", key).stdout

    changed = json.loads(receipt.read_text())
    changed["receipt"]["body"] = changed["receipt"]["body"].replace("false", "true")
    receipt.write_text(json.dumps(changed))
    ran = run("keys", "verify-receipt", receipt, "--public-key", key, "--json")
    assert ran.status == 1
    assert ran.json["valid"] is False
    assert run("keys", "verify-receipt", receipt, "--public-key", "%%").status == 2
