"""GET /v1/key: a key sees itself, and nothing else."""

from api.http.schemas import KeyAnswer
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer
from tests.api.shapes import assert_answer, assert_error


def test_a_key_sees_what_it_is(client: Client, deployment: Deployment) -> None:
    body = assert_answer(client.get("/v1/key"), 200, KeyAnswer)
    assert body["tenant"] == "default"
    assert body["rights"] == [
        "enroll", "verify", "erase", "export", "scores", "embeddings", "metrics", "admin",
    ]  # fmt: skip
    assert body["expires_at"] is None
    assert body["demo"] is False
    assert deployment.token.split("_")[1] == body["prefix"]
    assert deployment.token.split("_")[2] not in str(body)


def test_nobody_sees_nothing(client: Client) -> None:
    for headers in (bearer("vf_x"), {"Authorization": ""}):
        assert_error(client.get("/v1/key", headers=headers), 401, "unauthorized")
