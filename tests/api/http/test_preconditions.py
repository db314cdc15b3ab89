"""``If-None-Match`` and ``If-Match`` of an enrollment, on both databases."""

import pytest
from httpx import Response

from api.http.schemas import EnrollmentAnswer, ImportAnswer, SubjectAnswer
from tests.api.client import Client
from tests.api.deployment import Deployment, images, photo
from tests.api.shapes import assert_answer, assert_error

NEVER = {"If-None-Match": "*"}


def path(subject: str) -> str:
    return f"/v1/subjects/{subject}/enrollment"


def only(template_id: str) -> dict[str, str]:
    return {"If-Match": f'"{template_id}"'}


def template_id(client: Client, subject: str) -> str:
    answer = client.get(f"/v1/subjects/{subject}")
    named = assert_answer(answer, 200, SubjectAnswer)["template_id"]
    assert answer.headers["ETag"] == f'"{named}"'
    return named


def test_what_may_be_replaced(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    sent = {"files": images(photo(1))}
    refused = client.put(path("ann"), headers=only("0" * 32), **sent)
    assert assert_error(refused, 409, "enrollment_conflict") == {"template_id": None}
    assert client.get("/v1/subjects/ann").status_code == 404

    created = client.put(path("ann"), headers=NEVER, **sent)
    first = assert_answer(created, 201, EnrollmentAnswer)["template_id"]
    assert created.headers["ETag"] == f'"{first}"'
    for headers in (NEVER, only("0" * 32)):
        refused = client.put(path("ann"), headers=headers, **sent)
        assert assert_error(refused, 409, "enrollment_conflict") == {"template_id": first}
        assert template_id(client, "ann") == first

    replaced = client.put(path("ann"), headers=only(first), **sent)
    second = assert_answer(replaced, 200, EnrollmentAnswer)["template_id"]
    assert second == template_id(client, "ann") != first
    # A template that was replaced is not there to be replaced again.
    assert_error(client.put(path("ann"), headers=only(first), **sent), 409, "enrollment_conflict")
    assert client.delete("/v1/subjects/ann").status_code == 200
    assert_error(client.put(path("ann"), headers=only(second), **sent), 409, "enrollment_conflict")
    assert client.put(path("ann"), headers=NEVER, **sent).status_code == 201


def test_an_import_heeds_them(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    client.put(path("ann"), files=images(photo(1)))
    first = template_id(client, "ann")
    sent = {"json": {"export": client.get("/v1/subjects/ann/export").json()["export"]}}

    def bring(headers: dict[str, str]) -> Response:
        return client.post("/v1/subjects/import", headers=headers, **sent)

    for headers in (NEVER, only("0" * 32)):
        assert assert_error(bring(headers), 409, "enrollment_conflict") == {"template_id": first}
    assert template_id(client, "ann") == first
    assert_answer(bring(only(first)), 200, ImportAnswer)
    second = template_id(client, "ann")
    assert second != first


@pytest.mark.parametrize("headers", [NEVER, only("0" * 32), {"If-Match": "*"}])
def test_an_erasure_does_not_pass_over_them(
    both: tuple[Client, Deployment], headers: dict[str, str]
) -> None:
    client, _ = both
    client.put(path("ann"), files=images(photo(1)))
    refused = client.delete("/v1/subjects/ann", headers=headers)
    details = assert_error(refused, 422, "validation_failed")
    assert details == {"field": "If-Match, If-None-Match"}
    assert template_id(client, "ann")
    assert client.delete("/v1/subjects/ann").status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {"If-None-Match": '"0123"'},
        {"If-None-Match": ""},
        {"If-Match": "*"},
        {"If-Match": "0123"},
        {"If-Match": 'W/"0123"'},
        {"If-Match": '"0123", "4567"'},
        {"If-Match": '"../0"'},
        {"If-Match": ""},
        {"If-Match": '"0123"', "If-None-Match": "*"},
    ],
)
def test_any_other_precondition_is_refused(client: Client, headers: dict[str, str]) -> None:
    answer = client.put(path("other"), files=images(photo(3)), headers=headers)
    assert assert_error(answer, 422, "validation_failed")["field"] == "If-Match, If-None-Match"
    assert "0123" not in answer.json()["error"]["message"]
    assert client.get("/v1/subjects/other").status_code == 404
