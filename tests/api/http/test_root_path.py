"""The service under a path of a proxy: page, reference, document and calls with right URLs."""

import re
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urljoin

import httpx
import pytest

from api.http.app import create_app
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, photo
from tests.api.server_process import Server
from tests.api.shapes import assert_error
from tests.patience import PATIENCE_S
from tests.ports import free_port
from tests.reliability.proxy import PAGE, require_nginx, running_nginx
from tests.web.conftest import chromium
from veilface_client import Client as ServiceClient

__all__ = ["chromium"]

PREFIX = "/faces"
METRICS = f"location ~ ^({PREFIX})+/metrics$"


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


@pytest.fixture(scope="module", params=["", "/"], ids=["passed on", "taken away"])
def proxied(
    request: pytest.FixtureRequest,
    deployment: Deployment,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[str]:
    """The URL of the page behind nginx, by the block of ``docs/deploy.md``."""
    require_nginx()
    folder = tmp_path_factory.mktemp("nginx")
    assert f"`{METRICS}`" in PAGE
    (block,) = re.findall(r"```nginx\n(limit_conn_zone .*?)```", PAGE, re.S)
    for written, changed in (
        ("location / {", f"location {PREFIX}/ {{"),
        ("http://127.0.0.1:8421", f"http://127.0.0.1:{deployment.settings.port}{request.param}"),
        ("location = /metrics", METRICS),
    ):
        assert block.count(written) == 1
        block = block.replace(written, changed)
    with Server(deployment, folder), running_nginx(block, folder / "n", "127.0.0.1") as url:
        yield f"{url}{PREFIX}/"


@pytest.mark.long
def test_behind_a_real_proxy_everything_leads_somewhere(
    proxied: str, deployment: Deployment
) -> None:
    with httpx.Client(verify=False, timeout=PATIENCE_S, follow_redirects=True) as http:
        assert str(http.get(proxied.rstrip("/")).url) == proxied
        for page in (proxied, urljoin(proxied, "docs")):
            named = re.findall(r'(?:href|src)="([^"#]+)"', http.get(page).text)
            assert named
            for name in named:
                assert http.get(urljoin(page, name)).status_code == 200, name
        (server,) = http.get(urljoin(proxied, "v1/openapi.json")).json()["servers"]
        key = urljoin(proxied, server["url"] + "/v1/key")
        assert http.get(key, headers=bearer(deployment.token)).status_code == 200
        for path in ("metrics", "%6detrics", "faces/metrics", "faces/faces/metrics"):
            answer = http.get(urljoin(proxied, path))
            # In HTML by nginx: the service's own answers are JSON.
            assert (answer.status_code, answer.headers["content-type"]) == (404, "text/html"), path
        assert http.get(urljoin(proxied, "v1/subjects/metrics")).status_code == 401
    with ServiceClient(proxied, deployment.token, verify=False) as client:
        client.enroll("anna", [photo(1), photo(1, 1)])
        assert client.verify("anna", photo(1, 2))
