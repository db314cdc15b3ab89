"""``veilface keys renew``: what it renews, what it says, and that a kill of it loses nothing."""

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from api.service.opening import open_keyring, open_store
from api.settings import Settings
from templates.errors import StoreError
from templates.keys.sealing import MasterKeyring
from templates.store import By, TemplateStore, count_wrapped, verify_audit_log
from templates.store.audit_archive import verify_archive
from templates.store.receipts import public_key_of, verify_receipt
from templates.store.secrets import SecretName
from tests.api.cli.conftest import copied, key_file, run
from tests.templates.store.conftest import put
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
    return run("keys", "renew", data / "archive.jsonl", "--data-dir", data, *options)


@pytest.fixture
def used(data: Path) -> tuple[Path, dict[str, Any]]:
    """A data folder with a bit of everything, and what was known of it before it was stolen."""
    assert run("db", "upgrade", "--data-dir", data).status == 0
    with opened(data) as store:
        store.tenants.create("default")
        token = store.api_keys.create("default", ["verify"], by=By("operator:test")).token
        for subject in PEOPLE:
            put(store, subject, subject.encode())
        known = {
            "receipt": store.erasures.erase("default", "carol").receipt,
            "token": token,
            "secrets": {name: store.secrets.get(name) for name in SecretName},
            "master_key": MasterKeyring.load(key_file(data)).current,
        }
    return data, known


def assert_renewed(data: Path, known: dict[str, Any]) -> None:
    """Nothing of before is lost, and no secret of before is in force."""
    keyring = MasterKeyring.load(key_file(data))
    assert len(keyring.key_ids) == 1
    assert keyring.current != known["master_key"]
    with opened(data) as store:
        assert set(count_wrapped(store)) == {keyring.current}
        for name in SecretName:
            same = store.secrets.get(name) == known["secrets"][name]
            assert same is (name in {SecretName.PSEUDONYM, SecretName.LIFTS}), name
        assert store.tenants.get("default").rotation_epoch > 1
        for subject in PEOPLE:
            template = store.subjects.get("default", subject)
            assert template is not None
            assert template.wire == subject.encode()
        assert store.api_keys.verify(known["token"]) is not None
        again = store.erasures.receipt("default", "carol")
        assert again is not None
        claims = verify_receipt(again, store.signer.public_key())
        assert claims["receipt_id"] == known["receipt"].claims["receipt_id"]
        with pytest.raises(StoreError):
            verify_receipt(known["receipt"], store.signer.public_key())
        assert verify_audit_log(store).intact


def test_it_renews_all_and_says_what_is_left_to_do(used: tuple[Path, dict[str, Any]]) -> None:
    data, known = used
    with opened(data) as store:
        earlier = str(store.audit_log.head())
    ran = renew(data)
    assert ran.status == 0, ran.stderr
    assert_renewed(data, known)
    with opened(data) as store:
        (key,) = store.api_keys.all()
        anchor = str(store.audit_log.head())
        assert next(store.audit_log.lines()).action == "secrets-renew"
        with pytest.raises(StoreError):
            verify_archive(data / "archive.jsonl", store.signer.public_key())
    for said in (
        f"anchor: {anchor}\n",
        "enroll again default: ada, bob\n",
        f"replace api keys: {key.prefix}\n",
        "receipts signed again: 1\n",
    ):
        assert said in ran.stdout
    assert "Renewing every secret" in ran.stderr
    before = public_key_of(known["secrets"][SecretName.RECEIPT])
    assert verify_archive(data / "archive.jsonl", before).lines > 0
    # The log goes on where the archive ends.
    for each in (earlier, anchor):
        assert run("audit-log", "verify", "--anchor", each, "--data-dir", data).status == 0


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


@pytest.mark.parametrize("kills", [4, pytest.param(40, marks=pytest.mark.long)])
def test_killed_at_any_statement_the_next_run_renews_all(
    used: tuple[Path, dict[str, Any]], kills: int, tmp_path: Path
) -> None:
    data, known = used
    status, said = renew_in_a_process(copied(data, tmp_path / "whole"), None)
    assert status == 0
    steps = int(said)
    assert steps > 40
    for number in range(kills):
        victim = copied(data, tmp_path / f"killed-{number}")
        last = (2 * number + 1) * steps // (2 * kills)
        status, _ = renew_in_a_process(victim, last)
        assert os.WTERMSIG(status) == signal.SIGKILL
        (victim / "archive.jsonl").unlink(missing_ok=True)
        ran = renew(victim)
        assert ran.status == 0, ran.stderr
        assert_renewed(victim, known)
