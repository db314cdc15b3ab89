"""The drill of docs/threat-model.md: the database, the master key and an API key were stolen."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from api.http.app import create_app
from templates.contract import wire
from templates.errors import SealError, StoreError
from templates.keys.probe_signature import signed_probe
from templates.keys.rotation import tenant_rotation
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from tests.api.cli.conftest import run
from tests.api.client import Client
from tests.api.deployment import Deployment, N, bearer, deploy, images, photo
from tests.api.shapes import assert_error

PEOPLE = {"alice": 1, "bob": 2}


class Thief:
    """What somebody has who took the database's file, the key file and a token."""

    def __init__(self, deployment: Deployment, token: str, folder: Path) -> None:
        folder.mkdir()
        self.token, self.folder = token, folder
        data = deployment.settings.data_dir
        for file in (*data.iterdir(), deployment.settings.resolved_master_key_file):
            if file.is_file():
                shutil.copy2(file, folder)
        self.store = TemplateStore(
            f"sqlite:///{folder / 'veilface.db'}", MasterKeyring.load(folder / "master.key")
        )

    def forged(self, subject: str) -> NDArray[np.float64]:
        """A unit vector of the stolen template, turned back: at distance 0 from it."""
        found = self.store.subjects.get("default", subject)
        assert found is not None
        key = self.store.tenants.rotation_key("default", epoch=found.record.rotation_epoch).key
        stolen = wire.decode(found.wire).subspace.rotated(tenant_rotation(key, N).T)
        rest = np.sqrt(1 - stolen.foot_norm**2)
        vector = stolen.foot.astype(np.float64) + rest * stolen.basis[0]
        unit: NDArray[np.float64] = vector / np.linalg.norm(vector)
        return unit

    def log_in(self, client: Client, subject: str, token: str) -> Any:
        body = signed_probe(token, subject, self.forged(subject))
        return client.post(f"/v1/subjects/{subject}/verify", json=body, headers=bearer(token))


def decision(client: Client, subject: str, token: str, shot: int) -> str:
    answer = client.post(
        f"/v1/subjects/{subject}/verify",
        files=images(photo(PEOPLE[subject], shot), name="image"),
        headers=bearer(token),
    )
    assert answer.status_code == 200, answer.text
    return str(answer.json()["decision"])


def enroll(client: Client, subject: str, token: str, *shots: int) -> int:
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment",
        files=images(*(photo(PEOPLE[subject], shot) for shot in shots)),
        headers=bearer(token),
    )
    return answer.status_code


def operator(deployment: Deployment, *command: str) -> Any:
    ran = run(*command, "--data-dir", deployment.settings.data_dir, "--json")
    assert ran.status == 0, ran.stderr
    return ran.json


def test_the_drill(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    with Client(create_app(deployment.settings)) as client:
        for subject in PEOPLE:
            assert enroll(client, subject, deployment.token, 0, 1) == 201
        thief = Thief(deployment, deployment.token, tmp_path / "loot")
        # The theft is one: a forged probe is accepted.
        assert thief.log_in(client, "alice", thief.token).json()["decision"] == "accept"

        operator(deployment, "keys", "rotate", "--retire")
        prefix = deployment.token[3:15]
        token = operator(deployment, "keys", "replace", prefix, "--grace-hours", "0")["token"]
        left = operator(deployment, "keys", "rotate-tenant", "--stolen")
        assert left["enroll_again"] == ["alice", "bob"]

        # The service ran all the while, and everybody can still log in with a photo.
        for subject in PEOPLE:
            assert decision(client, subject, token, 7) == "accept"
        assert_error(thief.log_in(client, "alice", thief.token), 401, "unauthorized")
        # A stolen template stays a credential for whoever gets another key that may send it.
        assert thief.log_in(client, "alice", token).json()["decision"] == "accept"

        for subject in PEOPLE:
            assert enroll(client, subject, token, 2, 3) == 200
        done = operator(deployment, "keys", "rotate-tenant", "--stolen", "--finish")
        assert (done["enroll_again"], done["rotations_dropped"]) == ([], 1)
        for subject in PEOPLE:
            assert thief.log_in(client, subject, token).json()["decision"] == "reject"
            assert decision(client, subject, token, 7) == "accept"

    # A second theft of the database, with the first one's keys, opens nothing.
    second = TemplateStore(
        deployment.settings.resolved_database_url,
        MasterKeyring.load(thief.folder / "master.key"),
    )
    with pytest.raises(SealError):
        second.subjects.get("default", "alice")
    with pytest.raises((SealError, StoreError)):
        second.tenants.rotation_key("default")
    second.close()
    thief.store.close()


def test_a_rotation_that_leaked_alone_costs_nobody_an_enrollment(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    with Client(create_app(deployment.settings)) as client:
        for subject in PEOPLE:
            assert enroll(client, subject, deployment.token, 0, 1) == 201
        store = client.app.state.runtime.store
        old = tenant_rotation(store.tenants.rotation_key("default").key, N)
        before = {
            name: wire.decode(store.subjects.get("default", name).wire).subspace for name in PEOPLE
        }
        done = operator(deployment, "keys", "rotate-tenant")
        assert (done["moved"], done["enroll_again"], done["rotations_dropped"]) == (2, [], 1)
        new = tenant_rotation(store.tenants.rotation_key("default").key, N)
        assert np.abs(new - old).max() > 0.1
        for name, subspace in before.items():
            after = wire.decode(store.subjects.get("default", name).wire).subspace
            assert np.linalg.norm(after.foot - subspace.foot) > 0.1
            turned = subspace.rotated(new @ old.T)
            assert np.allclose(after.foot, turned.foot, atol=2e-3)
            assert decision(client, name, deployment.token, 7) == "accept"
