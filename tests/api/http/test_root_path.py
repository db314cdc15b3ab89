"""The service under a path of a proxy: page, reference, document and calls with right URLs."""

from pathlib import Path

import pytest

from api.http.app import create_app
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy
from tests.api.shapes import assert_error
from tests.ports import free_port

PREFIX = "/faces"


@pytest.fixture(scope="module")
def deployment(tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    return deploy(tmp_path_factory.mktemp("prefix"), root_path=PREFIX, port=free_port())


@pytest.mark.parametrize("kept", [PREFIX, ""], ids=["passed on", "taken away"])
def test_the_calls_answer_with_the_path_and_without(deployment: Deployment, kept: str) -> None:
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        assert client.get(f"{kept}/v1/key").status_code == 200
        assert client.get(f"{kept}/health/live").status_code == 200
        assert client.get(f"{kept}/docs/start.js").status_code == 200
        assert client.get(f"{kept}/").text.startswith("<!doctype html>")
        assert client.get(f"{kept}/v1/openapi.json").json()["servers"] == [{"url": PREFIX}]
        refused = client.get(f"{kept}/v1/subjects/a/verify")
        assert_error(refused, 405, "method_not_allowed")
        assert refused.headers["allow"] == "POST"
        assert_error(client.get(f"{PREFIX}{PREFIX}/v1/key"), 404, "not_found")
        assert_error(client.get(f"{PREFIX}x/v1/key"), 404, "not_found")


def test_health_has_no_rate_limit_under_the_path(tmp_path: Path) -> None:
    settings = deploy(tmp_path, root_path=PREFIX, rate_limit_address="1/minute").settings
    with Client(create_app(settings)) as client:
        for path in ("/health/live", f"{PREFIX}/health/live") * 2:
            assert client.get(path).status_code == 200
        client.get("/v1/key")
        assert_error(client.get("/v1/key"), 429, "rate_limited")
