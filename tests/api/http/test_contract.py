import hashlib
from pathlib import Path

import numpy as np

from api.http.app import create_app
from api.http.schemas import ContractAnswer, HealthAnswer
from api.service.opening import file_sealer, open_keyring
from models.pack import ModelPack
from templates.decoys import DecoyGenerator, DecoyPool
from templates.keys.randomness import Keystream
from tests.api.client import Client
from tests.api.deployment import Deployment, N, bearer, deploy, make_contract, unit
from tests.api.shapes import assert_answer, assert_error


def test_the_contract_without_what_is_sealed(client: Client, deployment: Deployment) -> None:
    answer = client.get("/v1/contract")
    body = assert_answer(answer, 200, ContractAnswer)
    assert body["contract_id"] == deployment.contract.contract_id
    assert body["photos"] is True
    assert body["generator"] is True
    assert "sealed" not in body
    # A hundred strangers alone would fill some ten kilobytes.
    assert len(answer.content) < 10_000
    levels = [level["name"] for level in body["calibrations"][0]["levels"]]
    assert levels == ["fmr-1e-2", "fmr-1e-3", "accuracy"]


def test_the_generator_is_the_contracts(client: Client, deployment: Deployment) -> None:
    answer = client.get("/v1/contract/generator")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/octet-stream"
    loaded = DecoyGenerator.from_bytes(answer.content)
    assert loaded.source_id == deployment.contract.binding.decoy_source_id
    assert answer.headers["x-decoy-source-id"] == loaded.source_id
    drawn = loaded.draw(1, 2, stream=Keystream.seeded("x"))
    assert np.array_equal(drawn, deployment.source.draw(1, 2, stream=Keystream.seeded("x")))


def test_a_copy_of_the_generator_is_asked_for_again_and_not_sent_again(
    client: Client, deployment: Deployment
) -> None:
    path = "/v1/contract/generator"
    answer = client.get(path)
    etag = answer.headers["etag"]
    assert etag == f'"{hashlib.sha256(answer.content).hexdigest()}"'
    assert answer.headers["cache-control"] == "private, no-cache"
    again = client.get(path, headers={"If-None-Match": f'"other", W/{etag}'})
    assert (again.status_code, again.content, again.headers["etag"]) == (304, b"", etag)
    assert client.get(path, headers={"If-None-Match": '"other"'}).content == answer.content
    # A copy is of no use without the right.
    without = bearer(deployment.key("verify")) | {"If-None-Match": etag}
    assert_error(client.get(path, headers=without), 403, "forbidden")


def test_a_pool_is_never_given_away(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    settings = deployment.settings
    sealer = file_sealer(open_keyring(settings))
    pool = DecoyPool(unit(np.random.default_rng(0).normal(size=(300, N))))
    pool.save(settings.resolved_decoys_file, sealer)
    assert settings.pack is not None
    make_contract(ModelPack.load(settings.pack, threads=1), pool).save(
        settings.resolved_contract_file, sealer
    )
    with Client(create_app(settings), headers=bearer(deployment.token)) as client:
        assert_error(client.get("/v1/contract/generator"), 404, "not_found")
        assert client.get("/v1/contract").json()["generator"] is False


def test_health(client: Client) -> None:
    for path in ("/health/live", "/health/ready"):
        assert assert_answer(client.get(path), 200, HealthAnswer)["status"] == "ok"


def test_the_demo_says_so_in_every_answer(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, demo=True)
    notice = "demo model: not for authentication"
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        for path in ("/health/live", "/v1/contract", "/v1/contract/generator", "/nowhere"):
            assert client.get(path).headers["x-veilface-notice"] == notice
        assert client.get("/v1/contract").json()["notice"] == notice
