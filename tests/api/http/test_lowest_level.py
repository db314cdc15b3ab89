"""The lowest security level of a deployment and of a key, over REST and on the command line."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.service.opening import file_sealer, open_keyring, open_store
from api.service.runtime import Runtime
from tests.api.calls import embedding
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_error

LAX, STRICT = "fmr-1e-2", "fmr-1e-3"  # the contract's default is the strict one

Ask = Callable[..., httpx.Response]
"""Verifies a photo of the person, at a level or at none, with the key of the headers given."""


def key(deployment: Deployment, lowest_level: str | None) -> dict[str, str]:
    """Headers of a key that may verify with any probe."""
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        rights = ("verify", "embeddings")
        made = store.api_keys.create("default", rights, lowest_level=lowest_level)
    finally:
        store.close()
    return bearer(made.token)


def service(folder: Path, **changes: Any) -> Iterator[tuple[Client, Deployment]]:
    deployment = deploy(folder, lockout_after=0, **changes)
    with Client(create_app(deployment.settings)) as client:
        put = client.put(
            "/v1/subjects/a/enrollment", files=images(photo(1)), headers=bearer(deployment.token)
        )
        assert put.status_code == 201
        yield client, deployment


@pytest.fixture(scope="module")
def open_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, Deployment]]:
    """A deployment without a lowest level."""
    yield from service(tmp_path_factory.mktemp("open"))


@pytest.fixture(scope="module")
def strict_service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, Deployment]]:
    """A deployment whose lowest level is the strict one."""
    yield from service(tmp_path_factory.mktemp("strict"), lowest_level=STRICT)


def asker(client: Client) -> Ask:
    def ask(headers: dict[str, str], level: str | None = None) -> Any:
        fields = {} if level is None else {"level": level}
        sent = images(photo(1, 2), name="image")
        return client.post("/v1/subjects/a/verify", headers=headers, files=sent, data=fields)

    return ask


def level_of(answer: httpx.Response) -> str:
    assert answer.status_code == 200, answer.text
    return str(answer.json()["level"])


def test_what_is_below_the_level_of_the_deployment_is_forbidden(
    strict_service: tuple[Client, Deployment],
) -> None:
    ask = asker(strict_service[0])
    for lowest_of_key in (None, LAX):
        headers = key(strict_service[1], lowest_of_key)
        for level in (LAX, "accuracy"):
            answer = ask(headers, level)
            assert assert_error(answer, 403, "forbidden") == {"lowest_level": STRICT}
            assert f"{level} is below {STRICT}" in answer.json()["error"]["message"]
        assert level_of(ask(headers, STRICT)) == STRICT
        assert level_of(ask(headers)) == STRICT
        assert_error(ask(headers, "fmr-1e-9"), 422, "uncalibrated")


def test_an_embedding_is_held_to_the_level_too(
    strict_service: tuple[Client, Deployment],
) -> None:
    client, deployment = strict_service
    sent = {"embedding": embedding(client, 1), "level": LAX}
    headers = key(deployment, None)
    answer = client.post("/v1/subjects/a/verify", headers=headers, json=sent)
    assert assert_error(answer, 403, "forbidden") == {"lowest_level": STRICT}


def test_what_is_below_the_level_of_the_key_is_forbidden(
    open_service: tuple[Client, Deployment],
) -> None:
    ask = asker(open_service[0])
    strict, lax, free = (key(open_service[1], name) for name in (STRICT, LAX, None))
    assert assert_error(ask(strict, LAX), 403, "forbidden") == {"lowest_level": STRICT}
    assert level_of(ask(strict)) == STRICT
    assert [level_of(ask(headers, LAX)) for headers in (lax, free)] == [LAX, LAX]
    # A key of another contract's level decides nothing.
    other = key(open_service[1], "fmr-1e-9")
    for level in (None, LAX, STRICT):
        assert assert_error(ask(other, level), 403, "forbidden") == {"lowest_level": "fmr-1e-9"}


def test_a_default_below_the_lowest_gives_way(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, lowest_level=STRICT)
    contract = replace(deployment.contract, default_level=LAX)
    contract.save(
        deployment.settings.resolved_contract_file, file_sealer(open_keyring(deployment.settings))
    )
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).status_code == 201
        sent = images(photo(1, 2), name="image")
        assert level_of(client.post("/v1/subjects/a/verify", files=sent)) == STRICT


def test_a_refused_level_is_no_attempt(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, lowest_level=STRICT, lockout_after=1)
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).status_code == 201
        for level, status in ((LAX, 403), (LAX, 403), (STRICT, 200), (STRICT, 423)):
            sent = images(photo(2), name="image")
            answer = client.post("/v1/subjects/a/verify", files=sent, data={"level": level})
            assert answer.status_code == status


def test_a_key_is_told_what_it_may_ask_for(
    open_service: tuple[Client, Deployment], strict_service: tuple[Client, Deployment]
) -> None:
    def levels(running: tuple[Client, Deployment], lowest_of_key: str | None) -> Any:
        headers = key(running[1], lowest_of_key)
        return running[0].get("/v1/key", headers=headers).json()["levels"]

    assert levels(open_service, None) == [LAX, STRICT, "accuracy"]
    assert levels(open_service, STRICT) == levels(strict_service, None) == [STRICT]
    assert levels(open_service, "fmr-1e-9") == []


def test_a_level_that_the_contract_does_not_have_stops_the_start(tmp_path: Path) -> None:
    settings = deploy(tmp_path).settings.model_copy(update={"lowest_level": "fmr-1e-9"})
    with pytest.raises(StartError, match=r"setting lowest_level: .* no level fmr-1e-9; it has"):
        Runtime.open(settings)
