import pytest

from api.service.opening import open_keyring, open_store
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer
from tests.api.shapes import assert_error

CALLS = [
    ("PUT", "/v1/subjects/a/enrollment", "enroll"),
    ("POST", "/v1/subjects/a/verify", "verify"),
    ("GET", "/v1/subjects", "enroll"),
    ("GET", "/v1/subjects/a", "enroll"),
    ("DELETE", "/v1/subjects/a", "erase"),
    ("GET", "/v1/subjects/a/export", "export"),
    ("POST", "/v1/subjects/import", "export"),
    ("GET", "/v1/contract/generator", "embeddings"),
    ("GET", "/v1/contract", None),
]
RIGHTS = {"enroll", "verify", "erase", "export", "scores", "embeddings", "admin"}


@pytest.fixture(scope="module")
def keys(deployment: Deployment) -> dict[str, str]:
    """For each right, a key that has every other one."""
    return {right: deployment.key(*(RIGHTS - {right})) for right in RIGHTS}


@pytest.mark.parametrize(("method", "path", "right"), CALLS)
def test_every_call_needs_its_right(
    client: Client, keys: dict[str, str], method: str, path: str, right: str | None
) -> None:
    for headers in (
        {"Authorization": ""},
        {"Authorization": "Bearer"},
        {"Authorization": "Bearer nonsense"},
        {"Authorization": "Basic dXNlcjpwYXNz"},
        {"Authorization": "Bearer vf_000000000000_" + "0" * 64},
        {"Authorization": "Bearer " + "x" * 5000},
    ):
        answer = client.request(method, path, headers=headers)
        assert_error(answer, 401, "unauthorized")
        assert answer.headers["www-authenticate"] == "Bearer"
    if right is None:
        assert client.request(method, path, headers=bearer(keys["admin"])).status_code == 200
        return
    answer = client.request(method, path, headers=bearer(keys[right]))
    assert assert_error(answer, 403, "forbidden") == {"missing": [right]}


def test_rights_are_asked_before_the_body_is_read(client: Client, keys: dict[str, str]) -> None:
    answer = client.put(
        "/v1/subjects/a/enrollment",
        content=b"x",
        headers={**bearer(keys["enroll"]), "Content-Length": str(10**12)},
    )
    assert_error(answer, 403, "forbidden")


def test_a_revoked_key_stops_at_once(client: Client, deployment: Deployment) -> None:
    token = deployment.key("verify")
    assert client.get("/v1/contract", headers=bearer(token)).status_code == 200
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    assert store.api_keys.revoke(token.split("_")[1])
    store.close()
    assert_error(client.get("/v1/contract", headers=bearer(token)), 401, "unauthorized")


def test_a_wrong_secret_of_a_known_prefix_is_refused(
    client: Client, deployment: Deployment
) -> None:
    token = deployment.token
    changed = token[:-1] + ("0" if token[-1] != "0" else "1")
    assert_error(client.get("/v1/contract", headers=bearer(changed)), 401, "unauthorized")


@pytest.mark.parametrize("method", ["GET", "HEAD"])
@pytest.mark.parametrize("path", ["/health/live", "/health/ready"])
def test_health_needs_no_key(client: Client, method: str, path: str) -> None:
    assert client.request(method, path, headers={"Authorization": ""}).status_code == 200


@pytest.mark.parametrize(
    "token",
    ["x", "vf_", "vf_" + "0" * 77, "vf_000000000000_" + "F" * 64, "vf_000000000000_" + "0" * 65],
)
def test_what_is_no_token_costs_no_query(
    client: Client, monkeypatch: pytest.MonkeyPatch, token: str
) -> None:
    store = client.app.state.runtime.store
    asked: list[str] = []
    monkeypatch.setattr(store.api_keys, "verify", asked.append)
    assert_error(client.get("/v1/contract", headers=bearer(token)), 401, "unauthorized")
    assert asked == []
    good = "vf_000000000000_" + "0" * 64
    assert_error(client.get("/v1/contract", headers=bearer(good)), 401, "unauthorized")
    assert asked == [good]


def test_what_is_no_photo_needs_the_right_to_embeddings(
    client: Client, keys: dict[str, str]
) -> None:
    for method, path, body in (
        ("PUT", "/v1/subjects/a/enrollment", {"template": "eA=="}),
        ("POST", "/v1/subjects/a/verify", {"template": "eA=="}),
        ("POST", "/v1/subjects/a/verify", {"embedding": [1.0]}),
    ):
        answer = client.request(method, path, json=body, headers=bearer(keys["embeddings"]))
        assert assert_error(answer, 403, "forbidden") == {"missing": ["embeddings"]}
