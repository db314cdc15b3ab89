import json
from collections.abc import Iterator

import numpy as np
import pytest

from api.http.schemas import EnrollmentAnswer, VerifyAnswer
from templates.contract import wire
from tests.api.calls import b64, lifted
from tests.api.client import Client
from tests.api.deployment import Deployment, M, N, bearer, images, photo, unit
from tests.api.shapes import assert_answer, assert_error


def path(subject: str) -> str:
    return f"/v1/subjects/{subject}/enrollment"


def test_photos_enroll_on_both_databases(both: tuple[Client, Deployment]) -> None:
    client, deployment = both
    first = assert_answer(
        client.put(path("alice"), files=images(photo(1, 0), photo(1, 1), photo(1, 2))),
        201,
        EnrollmentAnswer,
    )
    assert first["contract_id"] == deployment.contract.contract_id
    assert [entry["index"] for entry in first["images"]] == [0, 1, 2]
    assert first["replaced"] is False
    again = assert_answer(client.put(path("alice"), files=images(photo(2))), 200, EnrollmentAnswer)
    assert again["replaced"] is True
    assert again["template_id"] != first["template_id"]
    # The replacement is what counts now.
    for person, decision in ((1, "reject"), (2, "accept")):
        answer = client.post(
            "/v1/subjects/alice/verify", files=images(photo(person, 9), name="image")
        )
        assert assert_answer(answer, 200, VerifyAnswer)["decision"] == decision


def test_the_same_photos_are_lifted_to_the_same_set(client: Client) -> None:
    """Two sets with the embedding in common and other decoys would meet in it."""
    for subject, shots in (("once", (0, 1)), ("again", (1, 0)), ("other", (0, 2))):
        sent = images(*(photo(6, shot) for shot in shots))
        assert client.put(path(subject), files=sent).status_code == 201
    spans = {}
    for subject in ("once", "again", "other"):
        template, in_rotation = client.app.state.runtime.read("default", subject)
        rotation = in_rotation.rotation.of(template.template_id)
        set_ = wire.decode(template.wire).subspace.turned_by(rotation.turned_back)
        rows = np.vstack([set_.foot, set_.basis]).astype(np.float64)
        spans[subject] = np.linalg.qr(rows.T)[0]
    cosines = {
        subject: np.linalg.svd(spans["once"].T @ spans[subject], compute_uv=False).min()
        for subject in ("again", "other")
    }
    assert cosines["again"] > 0.999  # half precision
    assert cosines["other"] < 0.9


def test_a_rejected_set_leaves_the_old_enrollment(client: Client) -> None:
    old = client.put(path("bob"), files=images(photo(1))).json()["template_id"]
    broken = client.put(path("bob"), files=images(photo(1), b"no picture"))
    assert assert_error(broken, 400, "unsupported_image")["image"] == 1
    mixed = client.put(path("bob"), files=images(photo(1), photo(1, 1), photo(2)))
    assert assert_error(mixed, 422, "inconsistent_images") == {"photos": [2]}
    said = mixed.json()["error"]["message"]
    assert said.startswith("photo 3 does not look like the person on photos 1 and 2;")
    assert client.get("/v1/subjects/bob").json()["template_id"] == old
    new = client.put(path("carol-new"), files=images(photo(1), photo(2)))
    assert assert_error(new, 422, "inconsistent_images") == {"photos": [0, 1]}
    assert_error(client.get("/v1/subjects/carol-new"), 404, "not_enrolled")


@pytest.fixture
def allowed(deployment: Deployment) -> Iterator[None]:
    """Templates that clients made may be enrolled during one test."""
    deployment.allow_templates()
    yield
    deployment.allow_templates(allowed=False)


def test_a_template_is_refused_until_the_operator_allows_it(
    both: tuple[Client, Deployment],
) -> None:
    client, deployment = both
    body = {"template": b64(lifted(deployment))}
    refused = client.put(path("lifted"), json=body)
    details = assert_error(refused, 403, "forbidden")
    assert details == {"tenant_setting": "template_enrollment"}
    assert "veilface db template-enrollment" in refused.json()["error"]["message"]
    assert client.get("/v1/contract").json()["template_enrollment"] is False
    deployment.allow_templates()
    assert client.get("/v1/contract").json()["template_enrollment"] is True
    assert_answer(client.put(path("lifted"), json=body), 201, EnrollmentAnswer)
    # What one tenant is allowed, another one is not.
    other = bearer(deployment.key("enroll", "embeddings", tenant="other"))
    assert_error(client.put(path("lifted"), json=body, headers=other), 403, "forbidden")
    exported = client.get("/v1/subjects/lifted/export").json()["export"]
    deployment.allow_templates(allowed=False)
    assert_error(client.put(path("lifted"), json=body), 403, "forbidden")
    # An export is the service's own, sealed file.
    assert client.post("/v1/subjects/import", json={"export": exported}).status_code == 200


@pytest.mark.usefixtures("allowed")
def test_a_template_enrolls(client: Client, deployment: Deployment) -> None:
    answer = client.put(path("lifted"), json={"template": b64(lifted(deployment))})
    body = assert_answer(answer, 201, EnrollmentAnswer)
    assert body["images"] == []
    marked = json.dumps({"template": b64(lifted(deployment))}).encode("utf-8-sig")
    sent = client.put(path("x"), content=marked, headers={"Content-Type": "application/json"})
    assert sent.status_code == 201
    described = client.get("/v1/subjects/lifted").json()
    assert (described["enrolled_by"], described["photos"]) == ("template", 0)
    descriptor = unit(np.random.default_rng([5, 0]).normal(size=(1, N)))[0]
    probe = client.post("/v1/subjects/lifted/verify", json={"embedding": descriptor.tolist()})
    assert probe.json()["decision"] == "accept"


@pytest.mark.usefixtures("allowed")
def test_broken_templates_are_refused(client: Client, deployment: Deployment) -> None:
    whole = lifted(deployment)
    cases = [
        ("", 400, "invalid_template"),
        ("not base64!", 400, "invalid_template"),
        ("@@@", 400, "invalid_template"),
        (b64(whole).replace("A", "*A", 1), 400, "invalid_template"),
        (b64(whole) + "\n", 400, "invalid_template"),
        (b64(whole[:-1]), 400, "invalid_template"),
        (b64(whole + b"\x00"), 400, "invalid_template"),
        (b64(b"\x00" * 100), 400, "invalid_template"),
        (b64(lifted(deployment, m=M - 1)), 400, "invalid_template"),
        (b64(lifted(deployment, contract_id="0" * 64)), 409, "contract_mismatch"),
        (7, 422, "validation_failed"),
        (None, 422, "validation_failed"),
        ([], 422, "validation_failed"),
    ]
    for template, status, code in cases:
        assert_error(client.put(path("x"), json={"template": template}), status, code)
    assert_error(client.put(path("x"), json={}), 422, "validation_failed")
    extra = client.put(path("x"), json={"template": b64(whole), "attributes": {}})
    assert "template" in assert_error(extra, 422, "validation_failed")["known"]


def test_fields_are_checked(client: Client) -> None:
    cases = [
        {"files": images(photo(1), name="image")},
        {"files": images(photo(1)), "data": {"lvl": "x"}},
        {"files": images(photo(1)), "data": {"face": "biggest"}},
        {"files": images(photo(1)), "data": {"face": ""}},
        {"files": images(photo(1)), "data": {"attributes": "{"}},
        {"files": images(photo(1)), "data": {"attributes": '{"age": "SECRET"}'}},
        {"files": images(photo(1)), "data": {"attributes": '{"gender": 1}'}},
        {"files": images(photo(1)), "data": {"attributes": "[" * 4000}},
        {"data": {"images": "text"}, "files": images(photo(1), name="other")},
    ]
    for case in cases:
        answer = client.put(path("x"), **case)  # type: ignore[arg-type]
        assert_error(answer, 422, "validation_failed")
        assert "SECRET" not in answer.text
        if "attributes" in case.get("data", {}):
            assert "with texts for gender and race" in answer.text
    for content_type in ("text/plain", "application/x-www-form-urlencoded", "image/png"):
        answer = client.put(path("x"), content=photo(1), headers={"Content-Type": content_type})
        assert_error(answer, 400, "malformed_request")


def test_attributes_and_face_are_accepted(client: Client) -> None:
    answer = client.put(
        path("attributes"),
        files=images(photo(1)),
        data={"attributes": json.dumps({"gender": "Female", "race": "Indian"}), "face": "largest"},
    )
    assert answer.status_code == 201
    assert "Indian" not in json.dumps(client.get("/v1/subjects/attributes").json())
