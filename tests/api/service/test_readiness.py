"""Readiness that is honest: after a failure, the thing that failed must succeed once."""

import json
import time
from itertools import product
from typing import Any

import pytest

from api.http.app import create_app
from api.service.metrics import MODEL_UP, STORE_UP
from models.errors import ModelError
from templates.store import TemplateStore
from tests.api.client import Client
from tests.api.deployment import Deployment, images, photo
from tests.api.shapes import assert_error
from tests.databases import execute
from tests.patience import wait_until

READY = "/health/ready"
EVENTS = ("INSERT", "UPDATE")


# Readiness


def refuse_writes(store: TemplateStore, *tables: str) -> None:
    """Let the database itself refuse to write, as one does that is full or read-only."""
    database = store.database
    does = "BEGIN SELECT RAISE(ABORT, 'full'); END"
    if not database.is_sqlite:
        does = "FOR EACH ROW EXECUTE FUNCTION no_room()"
        execute(
            database,
            "CREATE FUNCTION no_room() RETURNS trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE EXCEPTION USING ERRCODE = '53100'; END $$",
        )
    for table, event in product(tables, EVENTS):
        execute(database, f"CREATE TRIGGER full_{table}_{event} BEFORE {event} ON {table} {does}")


def take_writes(store: TemplateStore, *tables: str) -> None:
    for table, event in product(tables, EVENTS):
        on = "" if store.database.is_sqlite else f" ON {table}"
        execute(store.database, f"DROP TRIGGER full_{table}_{event}{on}")


def test_after_a_failed_write_a_write_must_succeed(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    store = client.app.state.runtime.store
    enroll = {"path": "/v1/subjects/a/enrollment", "files": images(photo(1))}
    assert client.get(READY).status_code == 200
    tables = ("subjects", "secrets")
    refuse_writes(store, *tables)
    # Nobody has tried to write yet: a database that answers is taken for one that works.
    assert client.get(READY).status_code == 200
    assert_error(client.put(**enroll), 503, "store_unavailable")
    assert STORE_UP._value.get() == 0
    for _ in range(2):
        assert_error(client.get(READY), 503, "store_unavailable")
    assert client.get("/health/live").status_code == 200
    assert client.get("/v1/subjects").status_code == 200  # reading still works
    take_writes(store, *tables)
    assert client.get(READY).status_code == 200
    assert STORE_UP._value.get() == 1
    assert client.put(**enroll).status_code == 201


def test_after_a_failed_inference_one_must_succeed(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack = client.app.state.runtime.pack
    assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).is_success
    verify = {"path": "/v1/subjects/a/verify", "files": images(photo(1), name="image")}
    inferences = 0
    embed = type(pack).embed

    def counted(self: Any, *given: Any, **named: Any) -> Any:
        nonlocal inferences
        inferences += 1
        return embed(self, *given, **named)

    def broken(*_: Any, **__: Any) -> None:
        raise ModelError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(type(pack), "embed", broken)
        assert_error(client.post(**verify), 503, "model_unavailable")
        assert MODEL_UP._value.get() == 0
        assert_error(client.get(READY), 503, "model_unavailable")
    monkeypatch.setattr(type(pack), "embed", counted)
    assert client.get(READY).status_code == 200
    assert (inferences, MODEL_UP._value.get()) == (1, 1)
    assert client.get(READY).status_code == 200
    assert inferences == 1  # a model that works is not asked each time


def test_a_mistake_of_the_client_does_not_make_the_service_unready(client: Client) -> None:
    for answer in (
        client.put("/v1/subjects/a/enrollment", files=images(b"no picture")),
        client.get("/v1/subjects/a%20b"),
        client.get("/v1/subjects/nobody"),
    ):
        assert 400 <= answer.status_code < 500
    assert STORE_UP._value.get() == MODEL_UP._value.get() == 1
    assert client.get(READY).status_code == 200


def test_recovery_is_seen_without_anybody_asking(
    deployment: Deployment, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "api.service.readiness.Readiness.watch.__kwdefaults__", {"every_s": 0.05}, raising=False
    )
    with Client(create_app(deployment.settings)) as client:
        store = client.app.state.runtime.store
        refuse_writes(store, "secrets")
        client.app.state.readiness.note(_store_error())
        time.sleep(0.3)
        assert STORE_UP._value.get() == 0
        take_writes(store, "secrets")
        wait_until(lambda: STORE_UP._value.get() == 1, what="the store's recovery")
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    said = [line["event"] for line in lines if line["event"].startswith("store")]
    assert said == ["store failed", "store is available again"]


def _store_error() -> Exception:
    from templates.errors import StoreUnavailable

    return StoreUnavailable("gone")
