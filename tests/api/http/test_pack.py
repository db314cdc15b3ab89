"""The graphs for clients that embed: who gets them, how they are named and kept."""

import hashlib
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.http.schemas import PackAnswer
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy
from tests.api.shapes import assert_answer, assert_error
from tests.marked_heads import write_marked_pack


@pytest.fixture(scope="module")
def serving(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A service that serves a pack with a detector, an embedder and liveness graphs beside them."""
    folder = tmp_path_factory.mktemp("serving")
    pack = write_marked_pack(folder / "buffalo_sc")
    deployment = deploy(folder, pack=pack, serve_pack=True)
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        yield client, deployment


def folder_of(deployment: Deployment) -> Path:
    assert deployment.settings.pack is not None
    return deployment.settings.pack


def token_of(client: Client, action: str) -> str:
    body = {"subject_id": "alice", "action": action}
    token: str = client.post("/v1/tokens", json=body).json()["token"]
    return token


def with_token(client: Client, action: str = "verify") -> dict[str, str]:
    return bearer(token_of(client, action))


def test_it_lists_the_graphs_that_the_contract_names(serving: tuple[Client, Deployment]) -> None:
    client, deployment = serving
    listed = assert_answer(client.get("/v1/pack", headers=with_token(client)), 200, PackAnswer)
    contract = client.get("/v1/contract").json()
    assert listed["contract_id"] == contract["contract_id"]
    assert listed["licence"] == "non-commercial research only (InsightFace)"
    roles = {entry["role"]: entry for entry in listed["files"]}
    assert list(roles) == ["detector", "embedder"]
    assert roles["embedder"]["sha256"] == contract["binding"]["embedder_sha256"]
    assert (roles["embedder"]["kind"], roles["detector"]["kind"]) == (None, "scrfd")
    for entry in listed["files"]:
        file = (folder_of(deployment) / entry["file"]).read_bytes()
        assert (entry["sha256"], entry["bytes"]) == (hashlib.sha256(file).hexdigest(), len(file))
        assert entry["path"] == f"/v1/pack/{entry['sha256']}"
        assert len(entry["input_size"]) == 2


def test_a_token_fetches_a_graph_and_keeps_it(serving: tuple[Client, Deployment]) -> None:
    client, deployment = serving
    for action in ("verify", "enroll"):
        headers = with_token(client, action)
        entry = client.get("/v1/pack", headers=headers).json()["files"][-1]
        answer = client.get(entry["path"], headers=headers)
        assert answer.status_code == 200
        assert answer.content == (folder_of(deployment) / entry["file"]).read_bytes()
        assert answer.headers["etag"] == f'"{entry["sha256"]}"'
        assert answer.headers["cache-control"] == "private, max-age=31536000, immutable"
        assert answer.headers["content-type"] == "application/octet-stream"
        assert answer.headers["x-content-type-options"] == "nosniff"
        kept = client.get(
            entry["path"], headers={**headers, "If-None-Match": answer.headers["etag"]}
        )
        assert (kept.status_code, kept.content) == (304, b"")
        # All of it, whatever range is asked for.
        for asked in ("bytes=8-23", "bytes=0-1,4-5", "bytes=99999999-", "pages=1"):
            whole = client.get(entry["path"], headers={**headers, "Range": asked})
            assert (whole.status_code, whole.content) == (200, answer.content)
            assert whole.headers["accept-ranges"] == "none"


def test_nothing_else_is_served(serving: tuple[Client, Deployment]) -> None:
    client, deployment = serving
    token = with_token(client)
    listed = client.get("/v1/pack", headers=token).json()["files"]
    entry = listed[0]
    for path in ("/v1/pack", entry["path"]):
        # To no API key, whatever its rights.
        assert assert_error(client.get(path), 403, "forbidden") == {"token": "missing"}
    for headers in ({"Authorization": ""}, bearer("vft_" + "0" * 12 + "_" + "A" * 200)):
        for path in ("/v1/pack", entry["path"]):
            assert_error(client.get(path, headers=headers), 401, "unauthorized")
    others = [path for path in folder_of(deployment).iterdir() if path.suffix == ".onnx"]
    unlisted = {hashlib.sha256(path.read_bytes()).hexdigest() for path in others} - {
        one["sha256"] for one in listed
    }
    for name in (
        *unlisted, entry["file"], "0" * 64, entry["sha256"].upper(), "..", "%2e%2epack.toml",
        "pack.toml",
    ):  # fmt: skip
        assert_error(client.get(f"/v1/pack/{name}", headers=token), 404, "not_found")


def test_it_is_off_by_default(client: Client) -> None:
    sha256 = client.get("/v1/contract").json()["binding"]["embedder_sha256"]
    for path in ("/v1/pack", f"/v1/pack/{sha256}"):
        assert_error(client.get(path, headers=with_token(client)), 404, "not_found")


def test_a_file_that_was_changed_is_not_given_under_the_old_hash(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, serve_pack=True)
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        client.headers.update(with_token(client))
        (entry,) = client.get("/v1/pack").json()["files"]
        file = folder_of(deployment) / entry["file"]
        file.write_bytes(file.read_bytes() + b"x")
        for path in (entry["path"], "/v1/pack"):
            assert_error(client.get(path), 503, "model_unavailable")
        file.unlink()
        for path in (entry["path"], "/v1/pack"):
            assert_error(client.get(path), 503, "model_unavailable")


def test_a_service_without_a_pack_has_none_to_serve(deployment: Deployment) -> None:
    settings = deployment.settings.model_copy(update={"serve_pack": True, "pack": None})
    with pytest.raises(StartError, match="serve_pack: there is no pack"):
        Client(create_app(settings)).__enter__()
