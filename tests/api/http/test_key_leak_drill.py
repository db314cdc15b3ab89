"""The drill of docs/threat-model.md: the database, the master key and an API key were stolen."""

import base64
import hashlib
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
from api.http.stand_ins import StandIns
from api.http.transfer import ExportKey, open_export
from templates.contract import wire
from templates.decoys import DecoySource, client_source
from templates.errors import InvalidTemplate, SealError, StoreError
from templates.keys.rotation import TenantRotation
from templates.keys.sealing import MasterKeyring
from templates.space.subspace import AffineSubspace
from templates.store import Anchor, Line, TemplateStore
from templates.store.audit_chain import head_mac, line_hash
from templates.store.authenticity import row_mac
from templates.store.database import Database
from templates.store.receipts import sign_claims
from templates.store.renewal import KEPT
from templates.store.schema import ApiKeyRow, AuditHeadRow, AuditRow
from templates.store.secret import SecretName
from tests.api.cli.conftest import run
from tests.api.client import Client
from tests.api.deployment import AXES, Deployment, bearer, deploy, images, photo, picture
from tests.api.shapes import assert_error

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
        self.row_key = self.store.audit_log.row_key()

    def stolen(self, subject: str) -> AffineSubspace:
        """The template, turned back."""
        found = self.store.subjects.get("default", subject)
        assert found is not None
        key = self.store.tenants.rotation_key("default", epoch=found.record.rotation_epoch).key
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

    def receipt(self, like: dict[str, Any], erased_at: str) -> dict[str, Any]:
        """A receipt under the stolen key."""
        claims = {**json.loads(like["receipt"]["body"]), "erased_at": erased_at}
        made_up = sign_claims(claims, self.secrets[SecretName.RECEIPT].value)
        return {"receipt": made_up.to_json()}

    def made_up_key(self, database: Database) -> str:
        """Put a key of all rights into the service's database, authentic under the stolen key."""
        (row,) = _rows(database, "SELECT * FROM api_keys LIMIT 1")
        prefix, token = "0123456789ab", f"vf_0123456789ab_{'5' * 64}"
        row |= {"id": "7" * 32, "prefix": prefix, "line": 0, "expires_at": None}
        row |= {"token_hash": hashlib.sha256(token.encode()).digest(), "rights": "admin,verify"}
        authentic = {
            **row,
            "tenant": "default",
            "created_at": datetime.fromisoformat(row["created_at"]).replace(tzinfo=UTC),
        }
        row["mac"] = row_mac(self.row_key, ApiKeyRow, authentic)
        names = ", ".join(row)
        values = ", ".join(f":{name}" for name in row)
        _write(database, f"INSERT INTO api_keys ({names}) VALUES ({values})", row)
        return token

    def write_line(self, database: Database, last: Anchor) -> None:
        """Add a line under the stolen key, and move the head."""
        columns: dict[str, Any] = dict.fromkeys(Line.__dataclass_fields__)
        columns |= {"sequence": last.sequence + 1, "action": "erase", "outcome": "erased"}
        columns |= {"previous_hash": last.hash, "at": datetime.now(UTC)}
        key = self.secrets[SecretName.CHAIN].value
        own_hash = line_hash(key, columns)
        head = Anchor(last.sequence + 1, own_hash)
        database.write(
            lambda connection: connection.execute(
                sa.insert(AuditRow).values(**{**columns, "hash": own_hash})
            )
        )
        moved = {"sequence": head.sequence, "hash": own_hash, "mac": head_mac(key, head)}
        database.write(lambda connection: connection.execute(sa.update(AuditHeadRow).values(moved)))


def _rows(database: Database, statement: str) -> list[dict[str, Any]]:
    return database.read(
        lambda connection: [row._asdict() for row in connection.execute(sa.text(statement))]
    )


def _write(database: Database, statement: str, values: dict[str, Any]) -> None:
    database.write(lambda connection: connection.execute(sa.text(statement), values))


def unit_vectors(
    template: AffineSubspace, embedding: NDArray[np.float32], source: DecoySource
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
        anchor = operator(deployment, "audit-log", "head")
        thief = Thief(deployment, deployment.token, tmp_path / "loot")
        pack = client.app.state.runtime.pack
        faces = {who: pack.embed(picture(PEOPLE[who], 9)[np.newaxis])[0] for who in PEOPLE}
        forged = {
            who: unit_vectors(thief.stolen(who), faces[who], deployment.source) for who in PEOPLE
        }
        # The theft is one: every vector of the template is accepted.
        assert set(thief.decisions(client, "alice", thief.token, forged["alice"])) == {"accept"}

        done = operator(deployment, "keys", "renew")
        prefix = deployment.token[3:15]
        assert done["replace_api_keys"] == [prefix]
        (tenant,) = done["tenants"]
        assert tenant["enroll_again"] == ["alice", "bob"]
        assert (done["retired"], set(done["secrets"])) == (1, set(SecretName) - KEPT)
        done_anchor = done["anchor"]
        token = operator(deployment, "keys", "replace", prefix, "--grace-hours", "0")["token"]

        # The service ran all the while, and everybody can still log in with a photo.
        for subject in PEOPLE:
            assert decision(client, subject, token, 7) == "accept"
        refused = thief.log_in(client, "alice", thief.token, forged["alice"][0])
        assert_error(refused, 401, "unauthorized")
        # A stolen template stays a credential for whoever gets another key that may send it.
        assert set(thief.decisions(client, "alice", token, forged["alice"])) == {"accept"}

        # The service ran all the while: no worker takes a key that the stolen secret vouches for.
        made_up = thief.made_up_key(service)
        assert_error(client.get("/v1/contract", headers=bearer(made_up)), 401, "unauthorized")
        _write(service, "DELETE FROM api_keys WHERE prefix = '0123456789ab'", {})

        contract = client.get("/v1/contract", headers=bearer(token)).json()
        good = verified(tmp_path, receipt, contract)
        assert good["key_id"] == receipt["claims"]["signing_key"]
        assert good["key_retired_at"] is not None
        late = thief.receipt(receipt, datetime.now(UTC).isoformat())
        assert verified(tmp_path, late, contract) is None
        again = client.delete("/v1/subjects/carol", headers=bearer(token)).json()
        assert again["claims"]["receipt_id"] == receipt["claims"]["receipt_id"]
        assert verified(tmp_path, again, contract)["key_retired_at"] is None
        back_dated = thief.receipt(receipt, receipt["claims"]["erased_at"])
        assert verified(tmp_path, back_dated, contract)["key_retired_at"] is not None

        stolen_key = ExportKey.from_secret(thief.secrets[SecretName.EXPORT])
        opening = {"key": stolen_key, "tenant": "default"}
        contract_id = deployment.contract.contract_id
        open_export(backup, contract_id=contract_id, **opening)
        with pytest.raises(InvalidTemplate):
            open_export(exported(client, "bob", token), contract_id=contract_id, **opening)
        assert_error(imported(client, backup, token), 400, "invalid_template")

        runtime = client.app.state.runtime
        stand_in = runtime.stand_ins.lift("default", "nobody")
        stolen_stand_in = StandIns(
            deployment.contract.nobody(deployment.source),
            runtime.keyring,
            contract_id=deployment.contract.contract_id,
            key=lambda: thief.secrets[SecretName.STAND_INS].value,
        ).lift("default", "nobody")
        assert (stand_in.foot != stolen_stand_in.foot).any()
        assert (
            thief.store.signer.pseudonym("default", "alice")
            == runtime.store.signer.pseudonyms("default", "alice")[-1]
        )
        assert thief.store.signer.pseudonym("default", "alice") != runtime.store.signer.pseudonym(
            "default", "alice"
        )

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
    with pytest.raises(SealError):
        second.subjects.get("default", "alice")
    with pytest.raises((SealError, StoreError)):
        second.tenants.rotation_key("default")
    with pytest.raises(SealError):
        second.audit_log.head()
    second.close()

    # The chain leads from before the theft to now; a line of the thief's does not pass.
    before = f"{anchor['sequence']}:{anchor['hash']}"
    for kept in (before, done_anchor):
        assert operator(deployment, "audit-log", "verify", "--anchor", kept)["intact"]
    head = operator(deployment, "audit-log", "head")
    thief.write_line(service, Anchor(head["sequence"], bytes.fromhex(head["hash"])))
    ran = run("audit-log", "verify", "--data-dir", deployment.settings.data_dir, "--json")
    assert (ran.status, ran.json["intact"]) == (1, False)
    service.close()
    thief.store.close()


def test_a_rotation_that_leaked_alone_costs_nobody_an_enrollment(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    with Client(create_app(deployment.settings)) as client:
        for subject in PEOPLE:
            assert enroll(client, subject, deployment.token, 0, 1) == 201
        store = client.app.state.runtime.store
        old = TenantRotation(store.tenants.rotation_key("default").key, AXES)
        before = {name: store.subjects.get("default", name) for name in PEOPLE}
        done = operator(deployment, "keys", "rotate-tenant")
        assert (done["moved"], done["enroll_again"], done["rotations_dropped"]) == (2, [], 1)
        new = TenantRotation(store.tenants.rotation_key("default").key, AXES)
        for name, stolen in before.items():
            subspace = wire.decode(stolen.wire).subspace
            after = wire.decode(store.subjects.get("default", name).wire).subspace
            assert np.linalg.norm(after.foot - subspace.foot) > 0.1
            plain = subspace.turned_by(old.of(stolen.template_id).turned_back)
            turned = plain.turned_by(new.of(stolen.template_id).turned)
            assert np.allclose(after.foot, turned.foot, atol=2e-3)
            assert decision(client, name, deployment.token, 7) == "accept"
