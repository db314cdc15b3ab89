"""A store from before templates had rotations of their own, under a contract calibrated anew."""

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from api.http.app import create_app
from api.http.errors import StartError
from api.http.transfer import Exported, seal_export
from api.process.opening import file_sealer, open_contract, open_keyring
from templates.contract import wire
from templates.keys.rotation import TenantRotation
from tests.api.cli.conftest import run
from tests.api.client import Client
from tests.api.deployment import Deployment, deploy, images, photo
from tests.api.earlier_rotation import earlier, enroll_earlier
from tests.api.shapes import assert_error

PEOPLE = {"ann": 1, "bob": 2, "eve": 3}


@pytest.fixture
def deployment(tmp_path: Path, database_url: str) -> Deployment:
    return deploy(tmp_path, database_url=database_url)


@pytest.fixture
def service(deployment: Deployment) -> Iterator[Client]:
    """It serves three templates of the earlier version."""
    app = create_app(deployment.settings)
    with Client(app, headers={"Authorization": f"Bearer {deployment.token}"}) as client:
        enroll_earlier(app.state.runtime, PEOPLE)
        yield client


def decision(client: Client, subject: str, person: int) -> str:
    sent = {"files": images(photo(person, 9), name="image")}
    answer = client.post(f"/v1/subjects/{subject}/verify", **sent)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["decision"])


def assert_all_are_served(client: Client) -> None:
    for name, person in PEOPLE.items():
        assert decision(client, name, person) == "accept"
        assert decision(client, name, 1 + person % 3) == "reject"


def test_it_is_served_and_moved_by_one_command(service: Client, deployment: Deployment) -> None:
    binding = deployment.contract.binding
    assert_all_are_served(service)
    described = service.get("/v1/subjects/ann").json()
    assert (described["contract_id"], described["current"]) == (
        earlier(binding).contract_id,
        True,
    )
    stored = service.get("/v1/subjects/ann/stored").json()
    assert (stored["current"], stored["strategy"]) == (True, str(binding.strategy))
    # One more, in the same epoch, in a rotation of its own.
    assert service.put("/v1/subjects/new/enrollment", files=images(photo(4))).status_code == 201
    before = {name: service.get(f"/v1/subjects/{name}").json() for name in PEOPLE}
    settings = deployment.settings
    ran = run(
        *("keys", "rotate-tenant", "--json", "--data-dir", settings.data_dir),
        *("--database-url", settings.resolved_database_url),
    )
    assert ran.status == 0, ran.stderr
    assert (ran.json["moved"], ran.json["enroll_again"], ran.json["rotations_dropped"]) == (
        4,
        [],
        1,
    )
    assert_all_are_served(service)
    assert decision(service, "new", 4) == "accept"
    for name, was in before.items():
        now = service.get(f"/v1/subjects/{name}").json()
        del was["request_id"], now["request_id"]
        assert now == {**was, "contract_id": binding.contract_id}


def test_its_templates_are_exported_and_its_exports_imported(
    service: Client, deployment: Deployment
) -> None:
    binding = deployment.contract.binding
    data = service.get("/v1/subjects/ann/export").json()
    assert data["contract_id"] == binding.contract_id
    assert service.delete("/v1/subjects/ann").status_code == 200
    sent = {"export": data["export"]}
    assert service.post("/v1/subjects/import", json=sent).status_code == 201
    assert decision(service, "ann", 1) == "accept"
    assert decision(service, "ann", 2) == "reject"
    assert service.get("/v1/subjects/ann").json()["contract_id"] == binding.contract_id

    # One that the earlier version sealed: under its own contract id, outside and inside.
    runtime: Any = service.app.state.runtime
    for other, status in ((earlier(binding), 201), (replace(earlier(binding), m=3), 409)):
        old = Exported(
            subject_id="zoe",
            contract_id=other.contract_id,
            source="photos",
            photos=1,
            wire=wire.encode(
                runtime.stand_ins.lift("default", "zoe"),
                contract_id=other.contract_id,
                dtype="float32",
            ),
        )
        blob = seal_export(old, key=runtime.export_key, tenant="default")
        answer = service.post(
            "/v1/subjects/import", json={"export": base64.b64encode(blob).decode()}
        )
        assert answer.status_code == status, answer.text
    assert_error(answer, 409, "contract_mismatch")
    stored = runtime.store.subjects.get("default", "zoe")
    key = runtime.store.tenants.rotation_key("default").key
    plain = wire.decode(stored.wire).subspace.turned_by(
        TenantRotation(key, binding.n).of(stored.template_id).turned_back
    )
    lifted = runtime.stand_ins.lift("default", "zoe")
    np.testing.assert_allclose(plain.foot, lifted.foot, atol=1e-3)


def test_its_contract_is_refused_with_the_remedy(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    settings, keyring = deployment.settings, open_keyring(deployment.settings)
    old = replace(
        deployment.contract,
        binding=earlier(deployment.contract.binding),
        calibrations=tuple(
            replace(each, calibration_id="") for each in deployment.contract.calibrations
        ),
    )
    old.save(settings.resolved_contract_file, file_sealer(keyring))
    with pytest.raises(StartError, match="run `veilface calibrate --strategy adversarial --dim 8`"):
        open_contract(settings, keyring)
    ran = run("keys", "rotate-tenant", "--data-dir", settings.data_dir)
    assert ran.status == 1
    assert "run `veilface calibrate --strategy adversarial --dim 8`" in ran.stderr
    # Nothing was begun, and a new master key can still be given to the old file.
    assert run("keys", "rotate", "--data-dir", settings.data_dir).status == 0
    ran = run("keys", "rotate-tenant", "--stolen", "--json", "--data-dir", settings.data_dir)
    assert ran.json["rotation_epoch"] == 2
