"""The drill of docs/threat-model.md: the database, the master key and an API key were stolen."""

import base64
import json
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from numpy.typing import NDArray

from api.http.app import create_app
from api.http.receipts import read_receipt_key
from api.http.transfer import ExportKey, open_export
from templates.contract import wire
from templates.decoys import DecoySource, client_source
from templates.errors import InvalidTemplate, SealError
from templates.keys.rotation import TenantRotation
from templates.keys.sealing import MasterKeyring
from templates.space.subspace import SubspaceBatch
from templates.store import Right, TemplateStore
from templates.store.audit_archive import verify_archive
from templates.store.audit_chain import Anchor, Head, line_mac
from templates.store.audit_log import Line
from templates.store.database import Database
from templates.store.receipts import sign_claims
from templates.store.schema import ApiKeyRow, AuditHeadRow, AuditRow
from templates.store.secrets import SecretName
from tests.api.cli.conftest import run
from tests.api.client import Client
from tests.api.deployment import AXES, Deployment, bearer, deploy, images, photo, picture
from tests.api.shapes import assert_error
from tests.databases import execute

FORGET_MADE_UP = "DELETE FROM api_keys WHERE label = 'made up'"
PEOPLE = {"alice": 1, "bob": 2}
FACES = {**PEOPLE, "carol": 3}


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
        self.secrets = {name: self.store.secrets.get(name) for name in SecretName}

    def stolen(self, subject: str) -> SubspaceBatch:
        """The template, turned back."""
        found = self.store.subjects.get("default", subject)
        assert found is not None
        key = self.store.tenants.rotation_key("default", found.record.rotation_epoch)
        rotation = TenantRotation(key, AXES).of(found.template_id)
        return wire.decode(found.wire).subspace.turned_by(rotation.turned_back)

    @staticmethod
    def log_in(client: Client, subject: str, token: str, vector: NDArray[np.float64]) -> Any:
        body = {"embedding": vector.tolist()}
        return client.post(f"/v1/subjects/{subject}/verify", json=body, headers=bearer(token))

    def decisions(
        self, client: Client, subject: str, token: str, vectors: NDArray[np.float64]
    ) -> list[str]:
        answers = [self.log_in(client, subject, token, vector).json() for vector in vectors]
        return [str(answer["decision"]) for answer in answers]

    def receipt(self, like: dict[str, Any]) -> dict[str, Any]:
        """A receipt under the stolen key."""
        claims = json.loads(like["receipt"]["body"])
        return {"receipt": sign_claims(claims, self.secrets[SecretName.RECEIPT]).to_json()}

    def made_up_key(self, database: Database) -> str:
        """Make a key with the stolen secrets, and put its row into the service's database."""
        new = self.store.api_keys.create("default", ["admin", "erase", "verify"], label="made up")
        row = _read(self.store.database, ApiKeyRow, ApiKeyRow.label == "made up")
        execute(database, sa.insert(ApiKeyRow).values(row))
        execute(self.store.database, FORGET_MADE_UP)
        return new.token

    def write_line(self, database: Database) -> None:
        """Add a line under the stolen key, and move the head."""
        key = self.secrets[SecretName.CHAIN]
        row = _read(database, AuditHeadRow, AuditHeadRow.id == 1)
        last = Anchor(row["sequence"], row["line_mac"])
        line: dict[str, Any] = dict.fromkeys(Line.__dataclass_fields__)
        line |= {"sequence": last.sequence + 1, "action": "erase", "outcome": "erased"}
        line |= {"actor": "program", "at": datetime.now(UTC).isoformat()}
        line["mac"] = line_mac(key, line, last.mac)
        base = Anchor(row["base_sequence"], row["base_mac"])
        head = Head(base, Anchor(line["sequence"], line["mac"])).columns(key)
        execute(database, sa.insert(AuditRow).values(line), sa.update(AuditHeadRow).values(head))


def _read(database: Database, table: type[Any], condition: Any) -> dict[str, Any]:
    query = sa.select(table.__table__).where(condition)
    (row,) = execute(database, query)
    return dict(row._asdict())


def unit_vectors(
    template: SubspaceBatch, embedding: NDArray[np.float32], source: DecoySource
) -> NDArray[np.float64]:
    """Embeddings whose projections are of a template, each at distance 0 from it: (M, N).

    The first is the one most like the face; of the others the face has what the foot point has.
    """
    face = source.project(embedding[np.newaxis])[0]
    basis = template.basis.astype(np.float64)
    _, _, directions = np.linalg.svd((basis @ face)[np.newaxis])
    directions[0] *= np.sign(directions[0] @ basis @ face)
    points = template.foot + np.sqrt(1 - template.foot_norm**2) * (directions @ basis)
    return np.asarray(points @ client_source(source).axes.T, dtype=np.float64)


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
        files=images(*(photo(FACES[subject], shot) for shot in shots)),
        headers=bearer(token),
    )
    return answer.status_code


def operator(deployment: Deployment, *command: str) -> Any:
    ran = run(*command, "--data-dir", deployment.settings.data_dir, "--json")
    assert ran.status == 0, ran.stderr
    return ran.json


def verified(folder: Path, receipt: dict[str, Any], contract: dict[str, Any]) -> Any:
    """What ``veilface keys verify-receipt`` says; None where it refuses."""
    receipt_file, contract_file = folder / "receipt.json", folder / "contract.json"
    receipt_file.write_text(json.dumps(receipt))
    contract_file.write_text(json.dumps(contract))
    ran = run("keys", "verify-receipt", receipt_file, "--public-key", contract_file, "--json")
    return ran.json if ran.status == 0 else None


def exported(client: Client, subject: str, token: str) -> bytes:
    answer = client.get(f"/v1/subjects/{subject}/export", headers=bearer(token))
    assert answer.status_code == 200, answer.text
    return base64.b64decode(answer.json()["export"])


def imported(client: Client, data: bytes, token: str) -> Any:
    body = {"export": base64.b64encode(data).decode()}
    return client.post("/v1/subjects/import", json=body, headers=bearer(token))


def test_the_drill(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, lockout_after=50)
    service = Database(deployment.settings.resolved_database_url)
    with Client(create_app(deployment.settings)) as client:
        for subject in PEOPLE:
            assert enroll(client, subject, deployment.token, 0, 1) == 201
        assert enroll(client, "carol", deployment.token, 0) == 201
        backup = exported(client, "carol", deployment.token)
        receipt = client.delete("/v1/subjects/carol", headers=bearer(deployment.token)).json()
        contract = client.get("/v1/contract", headers=bearer(deployment.token)).json()
        assert verified(tmp_path, receipt, contract)
        thief = Thief(deployment, deployment.token, tmp_path / "loot")
        pack = client.app.state.runtime.pack
        faces = {who: pack.embed(picture(PEOPLE[who], 9)[np.newaxis])[0] for who in PEOPLE}
        forged = {
            who: unit_vectors(thief.stolen(who), faces[who], deployment.source) for who in PEOPLE
        }
        # The theft is one: every vector of the template is accepted.
        assert set(thief.decisions(client, "alice", thief.token, forged["alice"])) == {"accept"}
        made_up = thief.made_up_key(service)
        assert client.get("/v1/audit-log", headers=bearer(made_up)).status_code == 200

    # The service is stopped.
    execute(service, FORGET_MADE_UP)
    archive = tmp_path / "before.jsonl"
    done = operator(deployment, "keys", "renew", str(archive))
    prefix = deployment.token[3:15]
    assert (done["retired"], done["replace_api_keys"]) == (1, [prefix])
    assert done["enroll_again"] == {"default": ["alice", "bob"]}
    token = deployment.key(*Right)
    assert operator(deployment, "keys", "revoke", prefix)["revoked"]

    with Client(create_app(deployment.settings)) as client:
        # Everybody can still log in with a photo.
        for subject in PEOPLE:
            assert decision(client, subject, token, 7) == "accept"
        refused = thief.log_in(client, "alice", thief.token, forged["alice"][0])
        assert_error(refused, 401, "unauthorized")
        # A stolen template stays a credential for whoever gets another key that may send it.
        assert set(thief.decisions(client, "alice", token, forged["alice"])) == {"accept"}

        # Nothing that the stolen secrets make is good for anything.
        made_up = thief.made_up_key(service)
        assert_error(client.get("/v1/contract", headers=bearer(made_up)), 401, "unauthorized")
        execute(service, FORGET_MADE_UP)
        before, contract = contract, client.get("/v1/contract", headers=bearer(token)).json()
        again = client.delete("/v1/subjects/carol", headers=bearer(token)).json()
        assert again["claims"]["receipt_id"] == receipt["claims"]["receipt_id"]
        assert verified(tmp_path, again, contract)
        assert verified(tmp_path, receipt, contract) is None
        assert verified(tmp_path, thief.receipt(again), contract) is None
        stolen_key = ExportKey.from_secret(thief.secrets[SecretName.EXPORT])
        opening = {"key": stolen_key, "tenant": "default"}
        contract_id = deployment.contract.contract_id
        open_export(backup, contract_id=contract_id, **opening)
        with pytest.raises(InvalidTemplate):
            open_export(exported(client, "bob", token), contract_id=contract_id, **opening)
        assert_error(imported(client, backup, token), 400, "invalid_template")

        for subject in PEOPLE:
            assert enroll(client, subject, token, 2, 3) == 200
        done = operator(deployment, "keys", "rotate-tenant", "--stolen", "--finish")
        assert (done["enroll_again"], done["rotations_dropped"]) == ([], 1)
        for subject in PEOPLE:
            like_the_face, *others = thief.decisions(client, subject, token, forged[subject])
            # A face cannot be changed: who finds it in the template has a good probe.
            assert like_the_face == "accept"
            assert others.count("accept") <= 1
            assert decision(client, subject, token, 7) == "accept"

    # A second theft of the database, with the first one's keys, opens nothing.
    second = TemplateStore(
        deployment.settings.resolved_database_url,
        MasterKeyring.load(thief.folder / "master.key"),
    )
    for read in (
        lambda: second.subjects.get("default", "alice"),
        lambda: second.tenants.rotation_key("default", 2),
        second.audit_log.head,
    ):
        with pytest.raises(SealError):
            read()
    second.close()

    # The archive and the log are whole, and a line of the thief's does not pass.
    assert verify_archive(archive, read_receipt_key(before["receipt_key"])).lines > 0
    assert operator(deployment, "audit-log", "verify")["intact"]
    thief.write_line(service)
    ran = run("audit-log", "verify", "--data-dir", deployment.settings.data_dir, "--json")
    assert (ran.status, ran.json["intact"]) == (1, False)
    service.close()
    thief.store.close()
