import base64
import json
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.http.schemas import ExportAnswer, ImportAnswer
from api.http.transfer import MAGIC, PURPOSE, ExportKey, open_export
from api.service.runtime import Runtime
from templates.contract import wire
from templates.keys.sealing import MasterKeyring
from tests.api.calls import b64
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.shapes import assert_answer, assert_error

CONTRACT = "ab" * 32


def exported(client: Client, subject: str, person: int = 1) -> str:
    put = client.put(f"/v1/subjects/{subject}/enrollment", files=images(photo(person)))
    assert put.status_code in (200, 201)
    body = assert_answer(client.get(f"/v1/subjects/{subject}/export"), 200, ExportAnswer)
    return str(body["export"])


def verdict(client: Client, subject: str, person: int) -> str:
    answer = client.post(
        f"/v1/subjects/{subject}/verify", files=images(photo(person, 9), name="image")
    )
    return str(answer.json()["decision"])


def send(client: Client, data: str, token: str | None = None) -> Any:
    headers = {} if token is None else bearer(token)
    return client.post("/v1/subjects/import", json={"export": data}, headers=headers)


def test_there_and_back(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    data = exported(client, "travels")
    client.delete("/v1/subjects/travels")
    body = assert_answer(send(client, data), 201, ImportAnswer)
    assert (body["subject_id"], body["replaced"]) == ("travels", False)
    assert verdict(client, "travels", 1) == "accept"
    assert verdict(client, "travels", 2) == "reject"
    described = client.get("/v1/subjects/travels").json()
    assert (described["enrolled_by"], described["photos"]) == ("photos", 1)
    assert assert_answer(send(client, data), 200, ImportAnswer)["replaced"] is True


def test_an_import_needs_admin_too_and_leaves_a_line(both: tuple[Client, Deployment]) -> None:
    """An old export brings back who was erased: so the operator decides, and the log tells."""
    client, deployment = both
    data = exported(client, "anna")
    assert client.delete("/v1/subjects/anna").status_code == 200
    for rights in (("enroll", "export"), ("enroll", "admin")):
        assert_error(send(client, data, deployment.key(*rights)), 403, "forbidden")
    assert send(client, data, deployment.key("export", "admin")).status_code == 201
    assert verdict(client, "anna", 1) == "accept"
    log = client.app.state.runtime.store.audit_log.lines()
    imports = [line.outcome for line in log if line.action == "import"][-3:]
    assert imports == ["forbidden", "forbidden", "created"]


def test_what_travels_is_not_rotated_and_not_what_is_stored(
    client: Client, deployment: Deployment
) -> None:
    runtime: Runtime = client.app.state.runtime
    data = base64.b64decode(exported(client, "plain"))
    inside = open_export(
        data,
        key=runtime.export_key,
        tenant="default",
        contract_id=deployment.contract.contract_id,
    )
    plain = wire.decode(inside.wire).subspace
    pack = runtime.pack
    assert pack is not None
    own = deployment.source.project(pack.embed_photo(photo(1)).embedding[None])
    assert plain.contains(own, tol=0.02).all()
    stored = runtime.store.subjects.get("default", "plain")
    assert stored is not None
    assert not wire.decode(stored.wire).subspace.contains(own, tol=0.02).any()
    assert inside.wire not in data


def test_the_deployments_own_key_keeps_tenants_apart(
    client: Client, deployment: Deployment
) -> None:
    data = exported(client, "bound")
    other = bearer(deployment.key("export", "admin", tenant="other"))
    answer = client.post("/v1/subjects/import", json={"export": data}, headers=other)
    assert_error(answer, 400, "invalid_template")


def test_two_deployments_with_one_key_file_exchange(tmp_path: Path) -> None:
    key_file = tmp_path / "export.key"
    MasterKeyring.create(key_file)
    first = deploy(tmp_path / "one", export_key_file=key_file)
    second = deploy(tmp_path / "two", export_key_file=key_file)
    strange = deploy(tmp_path / "three")
    # The same pack, decoys and options give the same contract id; the cohorts do not matter.
    assert first.contract.contract_id == second.contract.contract_id
    with Client(create_app(first.settings), headers=bearer(first.token)) as client:
        data = exported(client, "moves")
    with Client(create_app(second.settings), headers=bearer(second.token)) as client:
        assert client.post("/v1/subjects/import", json={"export": data}).status_code == 201
        assert verdict(client, "moves", 1) == "accept"
        assert verdict(client, "moves", 2) == "reject"
    with Client(create_app(strange.settings), headers=bearer(strange.token)) as client:
        answer = client.post("/v1/subjects/import", json={"export": data})
        assert_error(answer, 400, "invalid_template")


def test_hostile_imports(client: Client, deployment: Deployment) -> None:
    data = base64.b64decode(exported(client, "victim"))
    before = client.get("/v1/subjects/victim").json()["template_id"]

    def send(blob: bytes) -> object:
        return client.post("/v1/subjects/import", json={"export": base64.b64encode(blob).decode()})

    for blob in (b"", MAGIC, data[:20], data[:45], data[:-1], data + b"\x00", b"\x00" + data):
        assert_error(send(blob), 400, "invalid_template")
    for at in range(len(MAGIC) + 32, len(data), max(1, len(data) // 25)):
        flipped = bytearray(data)
        flipped[at] ^= 1
        assert_error(send(bytes(flipped)), 400, "invalid_template")
    foreign = data[: len(MAGIC)] + bytes(32) + data[len(MAGIC) + 32 :]
    assert_error(send(foreign), 409, "contract_mismatch")
    for export in (None, 5, [], {}):
        assert_error(
            client.post("/v1/subjects/import", json={"export": export}), 422, "validation_failed"
        )
    assert_error(client.post("/v1/subjects/import", json={"export": "*"}), 400, "invalid_template")
    assert_error(
        client.post("/v1/subjects/import", json={"export": "", "subject_id": "x"}),
        422,
        "validation_failed",
    )
    assert client.get("/v1/subjects/victim").json()["template_id"] == before


def test_what_the_key_holder_sealed_is_still_checked(
    client: Client, deployment: Deployment
) -> None:
    runtime: Runtime = client.app.state.runtime
    contract_id = deployment.contract.contract_id
    for subject, source, photos, body, code in (
        ("a/b", "photos", 1, b"x", "validation_failed"),
        ("ok", "photos", 1, b"x", "invalid_template"),
        ("ok", "magic", 1, b"x", "invalid_template"),
        ("ok", "photos", -1, b"x", "invalid_template"),
        ("ok", "photos", 1, b"", "invalid_template"),
    ):
        held = {"subject_id": subject, "source": source, "photos": photos, "wire": b64(body)}
        key = runtime.export_key
        sealed = key.keyring.seal(
            json.dumps(held).encode(),
            purpose=PURPOSE,
            bound_to=key.bound_to(contract_id, "default"),
        )
        blob = MAGIC + bytes.fromhex(contract_id) + sealed
        answer = client.post(
            "/v1/subjects/import", json={"export": base64.b64encode(blob).decode()}
        )
        assert_error(answer, 422 if code == "validation_failed" else 400, code)


def test_a_bad_export_key_file_stops_the_start(tmp_path: Path) -> None:
    path = tmp_path / "export.key"
    path.write_text("x")
    with pytest.raises(StartError, match="export key"):
        ExportKey.from_file(path)


def test_export_needs_its_right_and_a_subject(client: Client, deployment: Deployment) -> None:
    assert_error(client.get("/v1/subjects/nobody/export"), 404, "not_enrolled")
    # Who is enrolled is told by this code to keys with enroll or admin only.
    blind = bearer(deployment.key("export", "verify", "erase"))
    assert_error(client.get("/v1/subjects/nobody/export", headers=blind), 404, "not_found")
    assert json.loads(client.get("/v1/subjects/nobody/export").text)["error"]["details"] == {}
