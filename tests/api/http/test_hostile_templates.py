"""Templates that a client made to be accepted for many people, sent over REST."""

import base64
import dataclasses
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from api.http.app import create_app
from api.http.schemas import EnrollmentAnswer
from api.service.opening import file_sealer, open_keyring
from attacks.stored.wolves import canonical
from models.pack import ModelPack
from templates.contract import wire
from templates.space.subspace import SubspaceBatch
from templates.store.schema import Source
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy
from tests.api.shapes import assert_answer, assert_error
from tests.verify.population import (
    M,
    contract,
    decoys,
    enrolled,
    photos_of,
    templates_of,
    wolf,
)

PEOPLE = M + 1
"""As many as a template's affine span can hold."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, Deployment]]:
    """A service whose contract is calibrated on a population that is spread as faces are."""
    deployment = deploy(tmp_path_factory.mktemp("hostile"), lockout_after=0)
    info = ModelPack.load(deployment.settings.pack, threads=1).info
    calibrated = contract()
    calibrated = dataclasses.replace(
        calibrated,
        binding=dataclasses.replace(
            calibrated.binding,
            embedder_sha256=info.embedder_sha256,
            preprocessing=info.preprocessing,
        ),
        calibrations=tuple(
            dataclasses.replace(each, calibration_id="") for each in calibrated.calibrations
        ),
    )
    sealer = file_sealer(open_keyring(deployment.settings))
    calibrated.save(deployment.settings.resolved_contract_file, sealer)
    decoys().save(deployment.settings.resolved_decoys_file)
    with Client(create_app(deployment.settings)) as client:
        client.headers.update(bearer(deployment.token))
        yield client, deployment


def put(client: Client, subject: str, template: SubspaceBatch) -> httpx.Response:
    contract_id = client.get("/v1/contract").json()["contract_id"]
    data = wire.encode(template, contract_id=contract_id)
    path = f"/v1/subjects/{subject}/enrollment"
    return client.put(path, json={"template": base64.b64encode(data).decode()})


def decision(client: Client, subject: str, embedding: NDArray[np.float32]) -> str:
    answer = client.post(
        f"/v1/subjects/{subject}/verify", json={"embedding": embedding.tolist()}
    ).json()
    return str(answer["decision"])


def many_people(photos: NDArray[np.float32]) -> SubspaceBatch:
    """The affine span of one photo each of M + 1 people, (M + 1, n)."""
    points = decoys().project(photos).astype(np.float64)
    return canonical(points[0], points[1:] - points[0])


def test_a_template_of_many_people_is_refused_by_default(
    service: tuple[Client, Deployment],
) -> None:
    client, deployment = service
    photos = photos_of(PEOPLE, 3, seed=31)
    template = many_people(photos[:, 0])
    low, high = client.get("/v1/contract").json()["template_foot_point_norm"]
    assert low <= template.foot_norm <= high
    refused = assert_error(put(client, "many", template), 403, "forbidden")
    assert refused == {"tenant_setting": "template_enrollment"}
    # What the operator takes on who allows it: other photos of all of them are accepted.
    deployment.allow_templates()
    try:
        assert_answer(put(client, "many", template), 201, EnrollmentAnswer)
        decisions = [decision(client, "many", photo) for photo in photos[:, 1:].reshape(-1, 64)]
    finally:
        deployment.allow_templates(allowed=False)
    assert decisions.count("accept") > 0.9 * len(decisions)


def test_a_wolf_is_refused_where_templates_are_allowed(
    service: tuple[Client, Deployment],
) -> None:
    client, deployment = service
    honest = templates_of(enrolled(1, seed=41), seed=41)[0]
    deployment.allow_templates()
    try:
        refused = put(client, "wolf", wolf())
        assert_error(refused, 400, "invalid_template")
        message = refused.json()["error"]["message"]
        assert "nearer to strangers" in message
        assert "lift photos of one person" in message
        assert_answer(put(client, "honest", honest), 201, EnrollmentAnswer)
    finally:
        deployment.allow_templates(allowed=False)
    assert client.get("/v1/subjects/wolf").status_code == 404
    assert decision(client, "honest", photos_of(1, 3, seed=41)[0, 0]) == "accept"
    exported = client.get("/v1/subjects/honest/export").json()["export"]
    assert client.post("/v1/subjects/import", json={"export": exported}).status_code == 200


def test_an_export_of_a_wolf_is_refused_unless_the_service_made_it_of_photos(
    service: tuple[Client, Deployment],
) -> None:
    from api.http.transfer import Exported, seal_export

    client, _deployment = service
    runtime = client.app.state.runtime
    for source, status in (("template", 400), ("photos", 201)):
        sealed = seal_export(
            Exported(
                subject_id=f"from-{source}",
                source=Source(source),
                photos=0 if source == "template" else 3,
                wire=wire.encode(wolf(), contract_id=runtime.contract.contract_id, dtype="float32"),
            ),
            key=runtime.export_key,
            contract_id=runtime.contract.contract_id,
            tenant="default",
        )
        body = {"export": base64.b64encode(sealed).decode()}
        assert client.post("/v1/subjects/import", json=body).status_code == status
