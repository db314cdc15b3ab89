import base64
import contextlib
import json
import stat
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from api.cli.master_keys import add_key, opened_store
from api.http.receipts import receipt_json
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from templates.contract.document import Contract
from templates.keys.key_file import read_key_file
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from tests.api.cli.conftest import key_file, run


@pytest.fixture
def store(data):
    opened = TemplateStore(f"sqlite:///{data / 'veilface.db'}", MasterKeyring.load(key_file(data)))
    opened.upgrade()
    yield opened
    opened.close()


def test_a_key_is_made_listed_and_revoked(veilface, store):
    made = veilface(
        *("keys", "create", "--right", "enroll", "--right", "verify"),
        *("--label", "shop", "--days", "30", "--lowest-level", "fmr-1e-4", "--json"),
    )
    assert made.status == 0, made.stderr
    token, prefix = made.json["token"], made.json["prefix"]
    found = store.api_keys.verify(token)
    assert found is not None
    assert sorted(found.rights) == ["enroll", "verify"]
    assert found.lowest_level == made.json["lowest_level"] == "fmr-1e-4"
    assert veilface("keys", "create", "--right", "verify", "--lowest-level", "?").status == 1

    listed = veilface("keys", "list", "--json")
    assert [(key["prefix"], key["label"]) for key in listed.json] == [(prefix, "shop")]
    assert token not in listed.stdout
    shown = veilface("keys", "list").stdout
    assert shown.startswith("API keys")
    assert prefix in shown
    none = veilface("keys", "list", "--tenant", "nobody").stdout
    assert none == "There are no API keys: `veilface keys create` makes one\n"

    assert veilface("keys", "revoke", prefix).status == 0
    assert store.api_keys.verify(token) is None
    again = veilface("keys", "revoke", prefix, "--json")
    assert again.status == 1
    assert again.json == {"prefix": prefix, "revoked": False}
    assert "revoked" in veilface("keys", "list").stdout


def test_the_token_alone_is_on_stdout_or_in_a_private_file(veilface, store, tmp_path):
    create = ("keys", "create", "--right", "verify", "--tenant", "new-tenant")
    made = veilface(*create)
    assert made.status == 0
    assert store.api_keys.verify(made.stdout.strip()).tenant == "new-tenant"
    assert "new-tenant" in made.stderr
    file = tmp_path / "key"
    kept = veilface(*create, "--out", file, "--json")
    assert (kept.status, kept.json["out"]) == (0, str(file))
    assert store.api_keys.verify(file.read_text().strip()).prefix == kept.json["prefix"]
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert file.read_text().strip() not in kept.stdout + kept.stderr
    before = veilface("keys", "list", "--json").json
    for out in (file, tmp_path / "absent" / "key"):
        assert veilface(*create, "--out", out).status == 1
    after = veilface("keys", "list", "--json").json
    assert [key["prefix"] for key in after] == [key["prefix"] for key in before]
    assert store.api_keys.verify(file.read_text().strip()) is not None


def test_rotation_wraps_everything_again_and_retires_the_old_key(world, veilface, data):
    photos = world.photos(1, range(3))
    assert veilface("enroll", "ann", *photos, "--pack", world.pack).status == 0
    old = key_file(data).read_text()
    ran = veilface("keys", "rotate", "--retire", "--json")
    assert ran.status == 0, ran.stderr
    assert ran.json["rewrapped"] >= 3
    assert ran.json["retired"] == 1
    assert [name.rsplit("/", 1)[-1] for name in ran.json["resealed_files"]] == ["contract.json"]
    new = key_file(data).read_text()
    assert len(new.split()) == 1
    assert new != old
    Contract.load(data / "contract.json", file_sealer(MasterKeyring.load(key_file(data))))
    probe = world.photos(1, range(3, 4))
    assert veilface("verify", "ann", *probe, "--pack", world.pack).status == 0
    again = veilface("keys", "rewrap", "--json")
    assert again.json["rewrapped"] == 0


def test_rotations_at_once_lose_no_key(veilface, data, monkeypatch):
    assert veilface("keys", "list").status == 0
    read, together = read_key_file, threading.Barrier(4)

    def read_slowly(path):
        with contextlib.suppress(threading.BrokenBarrierError):
            together.wait(0.5)  # all four read before one of them writes, if nothing stops them
        return read(path)

    settings = Settings(data_dir=data)
    keyring = open_keyring(settings)
    monkeypatch.setattr("templates.keys.sealing.read_key_file", read_slowly)
    with opened_store(settings, keyring) as store, ThreadPoolExecutor(4) as threads:
        for added in [threads.submit(add_key, settings, store) for _ in range(4)]:
            added.result()
    assert len(read(key_file(data))[0]) == 5


def test_a_receipt_is_verified_and_a_changed_one_is_not(store, tmp_path):
    store.tenants.create("default")
    answer = receipt_json(store.erasures.erase("default", "ann").receipt)
    receipt, contract = tmp_path / "receipt.json", tmp_path / "contract.json"
    key = base64.b64encode(store.signer.public_key()).decode()
    receipt.write_text(json.dumps({**answer, "request_id": "x"}))
    contract.write_text(json.dumps({"receipt_key": {"public_key": key}}))
    for public in (key, contract):
        ran = run("keys", "verify-receipt", receipt, "--public-key", public, "--json")
        assert ran.status == 0, ran.stderr
        assert ran.json["claims"]["held"] is False
        assert ran.json["claims"]["subject"] == store.signer.pseudonym("default", "ann")
    shown = run("keys", "verify-receipt", receipt, "--public-key", key).stdout
    assert shown.startswith("valid: yes\nclaims ")

    changed = json.loads(receipt.read_text())
    changed["receipt"]["body"] = changed["receipt"]["body"].replace("false", "true")
    receipt.write_text(json.dumps(changed))
    ran = run("keys", "verify-receipt", receipt, "--public-key", key, "--json")
    assert ran.status == 1
    assert ran.json["valid"] is False
    assert run("keys", "verify-receipt", receipt, "--public-key", "%%").status == 2


def test_a_tenants_rotation_is_renewed_and_nobody_enrolls_again(world, veilface, store):
    pack = ("--pack", world.pack)
    assert veilface("enroll", "ann", *world.photos(1, range(3)), *pack).status == 0
    before = store.subjects.get("default", "ann")
    ran = veilface("keys", "rotate-tenant", "--json")
    assert ran.status == 0, ran.stderr
    assert ran.json == {
        "tenant": "default",
        "rotation_epoch": 2,
        "moved": 1,
        "enroll_again": [],
        "rotations_dropped": 1,
    }
    after = store.subjects.get("default", "ann")
    assert (before.record.rotation_epoch, after.record.rotation_epoch) == (1, 2)
    assert before.wire != after.wire
    assert veilface("verify", "ann", *world.photos(1, range(3, 4)), *pack).status == 0
    assert veilface("verify", "ann", *world.photos(2, range(1)), *pack).status == 1


def test_stolen_templates_keep_their_rotation_until_they_are_enrolled_again(world, veilface, store):
    pack = ("--pack", world.pack)
    for number, name in ((1, "ann"), (2, "bob")):
        assert veilface("enroll", name, *world.photos(number, range(3)), *pack).status == 0
    ran = veilface("keys", "rotate-tenant", "--stolen", "--json")
    assert (ran.json["moved"], ran.json["enroll_again"]) == (0, ["ann", "bob"])
    assert ran.json["rotations_dropped"] == 0
    assert veilface("verify", "ann", *world.photos(1, range(3, 4)), *pack).status == 0
    assert veilface("enroll", "ann", *world.photos(1, range(3, 5)), *pack).status == 0
    ran = veilface("keys", "rotate-tenant", "--stolen", "--finish", "--json")
    assert (ran.json["rotation_epoch"], ran.json["enroll_again"]) == (2, ["bob"])
    assert veilface("enroll", "bob", *world.photos(2, range(3, 5)), *pack).status == 0
    ran = veilface("keys", "rotate-tenant", "--stolen", "--finish", "--json")
    assert (ran.json["enroll_again"], ran.json["rotations_dropped"]) == ([], 1)
    assert veilface("verify", "bob", *world.photos(2, range(2, 3)), *pack).status == 0


def test_master_keys_come_from_the_environment(veilface, data, monkeypatch):
    assert veilface("db", "upgrade").status == 0
    text = key_file(data).read_text()
    key_file(data).unlink()
    monkeypatch.setenv("SOME_VARIABLE", text)
    assert veilface("db", "check", "--master-key-variable", "SOME_VARIABLE").status == 0
    both = veilface(
        *("db", "check", "--master-key-file", "elsewhere"),
        *("--master-key-variable", "SOME_VARIABLE"),
    )
    assert both.status == 1
    assert "give one of master_key_file and master_key_variable" in both.stderr
    ran = veilface("db", "check", "--master-key-variable", "NO_SUCH_VARIABLE")
    assert ran.status == 1
    assert "NO_SUCH_VARIABLE" in ran.stderr
    assert text.strip() not in ran.stderr
    rotated = veilface("keys", "rotate", "--master-key-variable", "SOME_VARIABLE")
    assert rotated.status == 2
    assert "do not come from a file" in rotated.stderr
