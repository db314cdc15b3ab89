"""Expired records go by themselves, and a purge that fails harms nobody."""

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest
import sqlalchemy as sa

from api.http.app import create_app
from api.service.opening import open_keyring, open_store
from templates.errors import StoreUnavailable
from templates.store import By, TemplateStore
from templates.store.schema import FailedAttemptsRow, SubjectRow
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.databases import execute
from tests.patience import wait_until


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("api.service.housekeeping.EVERY_S", 1)


@pytest.fixture
def own(tmp_path: Path) -> Deployment:
    return deploy(tmp_path)


def records(store: TemplateStore) -> int:
    count = sa.select(sa.func.count()).select_from(FailedAttemptsRow)
    return int(execute(store.database, count)[0][0])


def expire_all(store: TemplateStore) -> None:
    at = sa.func.datetime("now", "-91 days")
    execute(store.database, sa.update(FailedAttemptsRow).values(last_failed_at=at))


def fail(store: TemplateStore, subject: str) -> None:
    """Count a failure on somebody who is not enrolled."""
    decided = SimpleNamespace(accepted=False, level="m")
    store.attempts.decide("default", subject, lambda _: decided, contract_id="c" * 64, by=By())


def test_expired_records_go_at_the_start_and_later(own: Deployment) -> None:
    store = open_store(own.settings, open_keyring(own.settings))
    fail(store, "before-the-start")
    expire_all(store)
    with Client(create_app(own.settings)):
        wait_until(lambda: records(store) == 0)
        fail(store, "while-it-runs")
        expire_all(store)
        fail(store, "still-wanted")
        wait_until(lambda: records(store) == 1)
    store.close()


def test_the_log_that_an_erasure_could_not_empty_is_emptied(own: Deployment) -> None:
    log = own.settings.data_dir / "veilface.db-wal"
    store = open_store(own.settings, open_keyring(own.settings))
    fail(store, "a-write")
    assert log.stat().st_size > 0
    with Client(create_app(own.settings)):
        wait_until(lambda: log.stat().st_size == 0)
    store.close()


def test_a_purge_that_fails_is_a_log_line(
    own: Deployment, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    tried = []

    def fail(self: TemplateStore, **_: object) -> bool:
        tried.append(True)
        raise StoreUnavailable("secret words")

    monkeypatch.setattr(TemplateStore, "purge", fail)
    with Client(create_app(own.settings), headers=bearer(own.token)) as client:
        wait_until(lambda: len(tried) >= 2)
        assert client.get("/v1/contract").status_code == 200
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines() if line[:1] == "{"]
    failed = [line for line in lines if line["event"] == "purge failed"]
    assert len(failed) == len(tried)
    assert failed[0]["error_type"] == "StoreUnavailable"
    assert "secret words" not in json.dumps(lines)
    assert lines[-1]["event"] == "stopped"


def test_subjects_whose_time_is_over_go_by_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = deploy(tmp_path, retention_days=30)
    with Client(create_app(own.settings)) as client:
        client.headers.update(bearer(own.token))
        for name in ("old", "young"):
            answer = client.put(f"/v1/subjects/{name}/enrollment", files=images(photo(1)))
            assert answer.status_code == 201
        store = client.app.state.runtime.store
        month_ago = datetime.now(UTC) - timedelta(days=31)
        old = sa.update(SubjectRow).values(updated_at=month_ago)
        execute(store.database, old.where(SubjectRow.subject_id == "old"))
        wait_until(lambda: client.get("/v1/subjects/old").status_code == 404)
        assert client.get("/v1/subjects/young").status_code == 200
        assert store.erasures.receipt("default", "old") is not None
