"""``veilface keys renew``: what it says, what it needs, and that no kill of it loses anything."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from api.http.receipts import read_receipt_keys, receipt_json, receipt_keys_json
from api.process.opening import open_keyring, open_store
from api.settings import Settings
from templates.keys.sealing import MasterKeyring
from templates.store import Anchor, By, TemplateStore
from templates.store.receipts import verify_under
from templates.store.renewal import KEPT
from templates.store.secret import SecretName
from tests.api.cli.conftest import copied, key_file, run
from tests.templates.store.conftest import put
from tests.templates.store.test_attempts import attempt
from tests.templates.store.test_concurrency import fork

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")

PEOPLE = ("ada", "bob")


@contextmanager
def opened(data: Path) -> Iterator[TemplateStore]:
    settings = Settings(data_dir=data)
    store = open_store(settings, open_keyring(settings))
    try:
        yield store
    finally:
        store.close()


def renew(data: Path, *options: str) -> Any:
    return run("keys", "renew", "--data-dir", data, *options)


@pytest.fixture
def used(data: Path) -> tuple[Path, dict[str, Any]]:
    """A data folder with a bit of everything, and what was known of it before it was stolen."""
    assert run("db", "upgrade", "--data-dir", data).status == 0
    with opened(data) as store:
        store.tenants.create("default")
        token = store.api_keys.create("default", ["verify"], by=By("operator:test")).token
        for subject in PEOPLE:
            put(store, subject, subject.encode())
        assert attempt(store, "ada") == "reject"
        known = {
            "receipt": store.erasures.erase("default", "carol").receipt,
            "token": token,
            "anchor": str(store.audit_log.head()),
            "secrets": {name: store.secrets.get(name).value for name in SecretName},
            "master_key": MasterKeyring.load(key_file(data)).current,
        }
    return data, known


def assert_renewed_once(data: Path, known: dict[str, Any]) -> None:
    """Nothing of before is lost, nothing of it is in force, and nothing was renewed twice."""
    keyring = MasterKeyring.load(key_file(data))
    assert len(keyring.key_ids) == 1
    assert keyring.current != known["master_key"]
    with opened(data) as store:
        assert set(store.wrapped_keys.count()) == {keyring.current}
        for name in SecretName:
            secret = store.secrets.get(name)
            if name in KEPT:
                assert (secret.value, secret.retired) == (known["secrets"][name], ())
                continue
            assert [before.value for before in secret.retired] == [known["secrets"][name]]
        assert store.tenants.get("default").rotation_epoch == 2
        assert store.renewal.tenants_left() == ()
        for subject in PEOPLE:
            template = store.subjects.get("default", subject)
            assert template is not None
            assert template.wire == subject.encode()
        assert store.api_keys.verify(known["token"]) is not None
        status = store.attempts.status("default", "ada")
        assert status is not None
        assert status.consecutive == 1
        _, key = verify_under(known["receipt"], store.signer.keys())
        assert key.retired_at is not None
        again = store.erasures.receipt("default", "carol")
        assert again is not None
        assert verify_under(again, store.signer.keys())[1].retired_at is None
        assert store.audit_log.verify(anchor=Anchor.parse(known["anchor"])).intact


def test_it_says_what_is_left_to_do(used: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    data, known = used
    ran = renew(data)
    assert ran.status == 0, ran.stderr
    with opened(data) as store:
        (key,) = store.api_keys.all()
        anchor = str(store.audit_log.head())
        keys = store.signer.keys()
    for said in (
        f"Keep this anchor of the audit log elsewhere: {anchor}",
        "Enroll these 2 subjects of tenant default again, with new photos:\n    ada\n    bob\n",
        "veilface keys rotate-tenant --tenant default --stolen --finish",
        f"veilface keys replace {key.prefix} --grace-hours 0",
        "audit-chain, export, pseudonym, receipt-signing, stand-ins",
    ):
        assert said in ran.stdout
    assert_renewed_once(data, known)

    assert run("keys", "replace", key.prefix, "--grace-hours", "0", "--data-dir", data).status == 0
    again = renew(data, "--finish", "--json")
    assert (again.json["secrets"], again.json["replace_api_keys"]) == ([], [])
    assert again.json["tenants"] == [
        {"tenant": "default", "rotation_epoch": 2, "enroll_again": ["ada", "bob"]}
    ]
    with opened(data) as store:
        for subject in PEOPLE:
            put(store, subject, b"of new photos")
        of_before = store.signer.pseudonyms("default", "carol")[-1]
    # When nobody is left, the stolen rotation key goes as well.
    assert renew(data, "--finish", "--json").json["tenants"][0]["enroll_again"] == []
    assert (
        run(*("keys", "rotate-tenant", "--stolen", "--finish", "--json", "--data-dir", data)).json[
            "rotations_dropped"
        ]
        == 0
    )
    shown = run("audit-log", "show", "--subject", "carol", "--data-dir", data).stdout
    assert [json.loads(line)["subject"] for line in shown.splitlines()] == [of_before]

    receipt, contract = tmp_path / "receipt.json", tmp_path / "contract.json"
    receipt.write_text(json.dumps(receipt_json(known["receipt"])))
    contract.write_text(json.dumps({"receipt_key": receipt_keys_json(keys)}))
    assert tuple(read_receipt_keys(receipt_keys_json(keys))) == keys
    checked = run("keys", "verify-receipt", receipt, "--public-key", contract)
    assert checked.status == 0
    assert f"{keys[1].key_id}, which was retired on" in checked.stdout
    contract.write_text(json.dumps({"receipt_key": {**receipt_keys_json(keys), "retired": [5]}}))
    assert run("keys", "verify-receipt", receipt, "--public-key", contract).status == 2


def test_nothing_is_finished_that_was_not_begun(used: tuple[Path, dict[str, Any]]) -> None:
    data, known = used
    ran = renew(data, "--finish")
    assert ran.status == 1
    assert "no renewal was interrupted" in ran.stderr
    assert MasterKeyring.load(key_file(data)).current == known["master_key"]


def test_master_keys_of_a_variable_are_put_there_first(
    used: tuple[Path, dict[str, Any]], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    data, known = used
    old = key_file(data).read_text()
    MasterKeyring.create(tmp_path / "fresh.key")
    fresh = (tmp_path / "fresh.key").read_text()
    key_file(data).unlink()
    variable = ("--master-key-variable", "SOME_VARIABLE")
    monkeypatch.setenv("SOME_VARIABLE", old)
    refused = renew(data, *variable)
    assert refused.status == 2
    assert "put a new key in front" in refused.stderr
    monkeypatch.setenv("SOME_VARIABLE", f"{fresh.strip()} {old.strip()}")
    ran = renew(data, *variable)
    assert ran.status == 0, ran.stderr
    assert "Drop the older master keys where they come from" in ran.stdout
    key_file(data).write_text(fresh)
    key_file(data).chmod(0o600)
    assert_renewed_once(data, known)


class Steps:
    """Counts the steps of a process that reach the disk, and kills it before one of them."""

    def __init__(self, last: int | None) -> None:
        self.count = 0
        self._last = last

    def __call__(self, *_: object) -> None:
        if self.count == self._last:
            os.kill(os.getpid(), signal.SIGKILL)
        self.count += 1

    def around(self, change: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*arguments: Any, **options: Any) -> Any:
            self()
            return change(*arguments, **options)

        return counted

    def watch(self) -> None:
        for event in ("before_cursor_execute", "commit"):
            sa.event.listen(sa.Engine, event, self)
        os.replace = self.around(os.replace)  # in this process, which ends


def renew_in_a_process(data: Path, last: int | None) -> tuple[int, str]:
    """Exit status of a process that renews, and the number of its steps."""

    def work(output: Any) -> None:
        steps = Steps(last)
        steps.watch()
        assert renew(data, "--json").status == 0
        print(steps.count, file=output)

    child, output = fork(work)
    with output:
        said = output.read()
    return os.waitpid(child, 0)[1], said


@pytest.mark.parametrize("kills", [3, pytest.param(40, marks=pytest.mark.long)])
def test_killed_at_any_statement_it_is_finished_by_the_next_run(
    used: tuple[Path, dict[str, Any]], kills: int, tmp_path: Path
) -> None:
    data, known = used
    status, said = renew_in_a_process(copied(data, tmp_path / "whole"), None)
    assert status == 0
    steps = int(said)
    assert steps > 40
    begun = 0
    for number in range(kills):
        victim = copied(data, tmp_path / f"killed-{number}")
        last = (2 * number + 1) * steps // (2 * kills)
        status, _ = renew_in_a_process(victim, last)
        assert os.WTERMSIG(status) == signal.SIGKILL
        ran = renew(victim, "--finish")
        if "no renewal was interrupted" in ran.stderr:
            assert MasterKeyring.load(key_file(victim)).current == known["master_key"]
            ran = renew(victim)
        else:
            begun += 1
        assert ran.status == 0, ran.stderr
        assert_renewed_once(victim, known)
    assert begun > kills // 2
