"""Calls from pages of other origins."""

from pathlib import Path

import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.settings import load_settings
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_error

OURS, OTHER = "https://app.example.org", "https://evil.example.org"
ASKED = {
    "Access-Control-Request-Method": "PUT",
    "Access-Control-Request-Headers": "authorization,content-type,if-none-match",
}
ENROLLMENT = "/v1/subjects/ann/enrollment"


@pytest.fixture(scope="module")
def deployed(tmp_path_factory: pytest.TempPathFactory) -> Deployment:
    return deploy(tmp_path_factory.mktemp("cors"), cors_origins=f"http://localhost:3000, {OURS}")


@pytest.fixture(scope="module")
def client(deployed: Deployment):
    with Client(create_app(deployed.settings)) as running:
        yield running


def listed(answer, name: str) -> set[str]:
    return {part.strip().lower() for part in answer.headers[name].split(",")}


def test_a_preflight_of_an_allowed_origin_needs_no_key(client: Client) -> None:
    for origin in (OURS, "http://localhost:3000"):
        answer = client.request("OPTIONS", ENROLLMENT, headers={"Origin": origin, **ASKED})
        assert answer.status_code == 200
        assert answer.headers["Access-Control-Allow-Origin"] == origin
        assert "origin" in listed(answer, "Vary")
        assert "put" in listed(answer, "Access-Control-Allow-Methods")
        assert {"authorization", "content-type", "if-none-match"} <= listed(
            answer, "Access-Control-Allow-Headers"
        )
        assert "Access-Control-Allow-Credentials" not in answer.headers


@pytest.mark.parametrize(
    "origin",
    [OTHER, f"{OURS}.evil.org", "https://app.example.org:8443", "http://app.example.org", "null",
     "https://APP.example.org", f"{OURS}/", "*", ""],
)  # fmt: skip
def test_no_other_origin_is_told_that_it_may(client: Client, origin: str) -> None:
    answer = client.request("OPTIONS", ENROLLMENT, headers={"Origin": origin, **ASKED})
    assert_error(answer, 405, "method_not_allowed")
    for each in (answer, client.get("/v1/key", headers={"Origin": origin})):
        assert "Access-Control-Allow-Origin" not in each.headers


def test_answers_and_errors_are_readable(client: Client, deployed: Deployment) -> None:
    page = {"Origin": OURS}
    refused = client.put(ENROLLMENT, headers=page)
    assert_error(refused, 401, "unauthorized")
    enrolled = client.put(ENROLLMENT, files=images(photo(1)), headers=page | bearer(deployed.token))
    assert enrolled.status_code == 201
    for answer in (refused, enrolled):
        assert answer.headers["Access-Control-Allow-Origin"] == OURS
        assert {"etag", "retry-after", "x-request-id"} <= listed(
            answer, "Access-Control-Expose-Headers"
        )
        assert "Access-Control-Allow-Credentials" not in answer.headers


def test_by_default_nobody_is_allowed(tmp_path: Path) -> None:
    with Client(create_app(deploy(tmp_path).settings)) as client:
        answer = client.request("OPTIONS", ENROLLMENT, headers={"Origin": OURS, **ASKED})
        assert_error(answer, 405, "method_not_allowed")
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert "Vary" not in answer.headers


@pytest.mark.parametrize(
    "origins",
    ["*", f"{OURS},*", f"{OURS}/", "app.example.org", "https://", "ftp://a.org", "https://A.org",
     "https://a.org:443", "http://a.org:80", "https://user@a.org", "null"],
)  # fmt: skip
def test_what_no_browser_sends_is_refused(origins: str) -> None:
    with pytest.raises(StartError, match=r"cors_origins.*list origins as browsers send them"):
        load_settings(cors_origins=origins)


def test_origins_are_read() -> None:
    assert load_settings().allowed_origins == frozenset()
    assert load_settings(cors_origins="").allowed_origins == frozenset()
    named = load_settings(cors_origins=f" {OURS} , http://[::1]:3000,http://a.org:8080")
    assert named.allowed_origins == {OURS, "http://[::1]:3000", "http://a.org:8080"}
