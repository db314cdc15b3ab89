import base64
import json

import numpy as np
import pytest

from api.errors import ApiError
from api.routes.enrollment import parse_attributes
from api.schemas import EnrollmentAnswer, VerifyAnswer
from templates import wire
from templates.lifting import Strategy, lift
from templates.randomness import Keystream
from tests.api.client import Client
from tests.api.deployment import Deployment, M, N, bearer, images, photo, unit
from tests.api.shapes import assert_answer, assert_error


def lifted(deployment: Deployment, *, seed: int = 0, m: int = M, contract_id: str = "") -> bytes:
    """A client's template of a random descriptor."""
    descriptor = unit(np.random.default_rng([5, seed]).normal(size=(1, N)))
    batch = lift(
        descriptor,
        strategy=Strategy.ADVERSARIAL,
        m=m,
        source=deployment.source,
        stream=Keystream.seeded("client", seed),
    )
    return wire.encode(batch[0], contract_id=contract_id or deployment.contract.contract_id)


def b64(data: bytes) -> str:
    return base64.b64encode(data).decode()


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


def test_a_rejected_set_leaves_the_old_enrollment(client: Client) -> None:
    old = client.put(path("bob"), files=images(photo(1))).json()["template_id"]
    broken = client.put(path("bob"), files=images(photo(1), b"no picture"))
    assert assert_error(broken, 400, "unsupported_image")["image"] == 1
    mixed = client.put(path("bob"), files=images(photo(1), photo(1, 1), photo(2)))
    assert assert_error(mixed, 422, "inconsistent_images") == {"pairs": [[0, 2], [1, 2]]}
    assert client.get("/v1/subjects/bob").json()["template_id"] == old
    new = client.put(path("carol-new"), files=images(photo(1), photo(2)))
    assert_error(new, 422, "inconsistent_images")
    assert_error(client.get("/v1/subjects/carol-new"), 404, "not_enrolled")


def test_a_template_enrolls(client: Client, deployment: Deployment) -> None:
    answer = client.put(path("lifted"), json={"template": b64(lifted(deployment))})
    body = assert_answer(answer, 201, EnrollmentAnswer)
    assert body["images"] == []
    described = client.get("/v1/subjects/lifted").json()
    assert (described["enrolled_by"], described["photos"]) == ("template", 0)
    descriptor = unit(np.random.default_rng([5, 0]).normal(size=(1, N)))[0]
    probe = client.post("/v1/subjects/lifted/verify", json={"embedding": descriptor.tolist()})
    assert probe.json()["decision"] == "accept"


def test_broken_templates_are_refused(client: Client, deployment: Deployment) -> None:
    whole = lifted(deployment)
    cases = [
        ("", 400, "invalid_template"),
        ("not base64!", 400, "invalid_template"),
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


def test_a_template_needs_the_right_to_send_embeddings(
    client: Client, deployment: Deployment
) -> None:
    token = deployment.key("enroll")
    answer = client.put(
        path("x"), json={"template": b64(lifted(deployment))}, headers=bearer(token)
    )
    assert assert_error(answer, 403, "forbidden") == {"missing": ["embeddings"]}
    photos = client.put(path("by-photo"), files=images(photo(3)), headers=bearer(token))
    assert photos.status_code == 201


def test_fields_are_checked(client: Client) -> None:
    cases = [
        {"files": images(photo(1), name="image")},
        {"files": images(photo(1)), "data": {"lvl": "x"}},
        {"files": images(photo(1)), "data": {"face": "biggest"}},
        {"files": images(photo(1)), "data": {"face": ""}},
        {"files": images(photo(1)), "data": {"attributes": "{"}},
        {"files": images(photo(1)), "data": {"attributes": '{"age": "20"}'}},
        {"files": images(photo(1)), "data": {"attributes": '{"gender": 1}'}},
        {"files": images(photo(1)), "data": {"attributes": "[" * 4000}},
        {"data": {"images": "text"}, "files": images(photo(1), name="other")},
        {"files": images(photo(1)), "params": {"level": "x"}},
        {"files": images(photo(1)), "params": {"face": "largest"}, "data": {"face": "single"}},
    ]
    for case in cases:
        assert_error(client.put(path("x"), **case), 422, "validation_failed")  # type: ignore[arg-type]
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


def test_attributes_never_stand_in_an_error() -> None:
    with pytest.raises(ApiError) as caught:
        parse_attributes('{"gender": "Female", "secret": "Indian"}')
    assert "Indian" not in str(caught.value.message)
