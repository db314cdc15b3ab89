"""What a call does not know: names in the query, bodies, content types, slashes in ids."""

import base64
import gzip
import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, images, photo
from tests.api.shapes import assert_error


def operations(client: Client) -> Iterator[tuple[str, str]]:
    for path, entry in client.app.openapi()["paths"].items():
        for method in entry:
            yield method.upper(), path.format(subject_id="alice", token_id="t", sha256="0" * 64)


def test_no_call_takes_an_unknown_query_parameter(client: Client) -> None:
    pages = [("GET", path) for path in ("/assets/main.js", "/docs", "/v1/openapi.json")]
    calls = [*operations(client), *pages]
    assert ("GET", "/health/live") in calls
    for method, path in calls:
        answer = client.request(method, path, params={"dry_run": "true"})
        details = assert_error(answer, 422, "validation_failed")
        assert "dry_run" not in details["known"]


def test_the_page_is_shown_whatever_a_link_adds_to_its_address(client: Client) -> None:
    page = client.get("/").text
    for query in ("?utm_source=x", "?a=1&a=2", "?%ff&", "?x"):
        answer = client.get(f"/{query}")
        assert (answer.status_code, answer.text) == (200, page)
    assert_error(client.request("GET", "/", content=b"x"), 422, "validation_failed")


@pytest.mark.parametrize(
    "query",
    [
        "limit=5&limit=6",
        "limit=%2B5",
        "limit=+5",
        "limit=5.0",
        "limit=1_0",
        "limit=",
        "limit",
        "prefix=%ff",
        "prefix=a&&limit=5",
        "Limit=5",
        "limit=5&subject=alice",
    ],
)
def test_a_query_has_one_reading(client: Client, query: str) -> None:
    assert_error(client.get(f"/v1/subjects?{query}"), 422, "validation_failed")


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("limit=0", "limit must be at least 1"),
        ("limit=1001", "limit must be at most 1000"),
        ("limit=many", "limit has a wrong value"),
    ],
)
def test_a_wrong_value_is_named_with_its_bound(client: Client, query: str, said: str) -> None:
    answer = client.get(f"/v1/subjects?{query}")
    details = assert_error(answer, 422, "validation_failed")
    assert details == {"field": "limit"}
    message = answer.json()["error"]["message"]
    assert said in message
    assert "many" not in message


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("DELETE", "/v1/subjects/alice%2Flockout"),
        ("GET", "/v1/subjects/alice%2fexport"),
        ("GET", "/v1/subjects/alice/tokens%2Ft"),
        ("GET", "/v1%2Fcontract"),
    ],
)
def test_an_encoded_slash_selects_no_call(client: Client, method: str, path: str) -> None:
    assert_error(client.request(method, path), 422, "validation_failed")


def test_a_call_that_takes_no_body_is_sent_none(client: Client) -> None:
    client.put("/v1/subjects/kept/enrollment", files=images(photo(1)))
    answer = client.delete("/v1/subjects/kept", json={"dry_run": True})
    assert_error(answer, 422, "validation_failed")
    assert client.get("/v1/subjects/kept").status_code == 200
    assert client.delete("/v1/subjects/kept", content=b"").status_code == 200


PHOTO = photo(1)
BASE64 = base64.b64encode(PHOTO).decode()


def test_photos_under_no_name_or_two_are_told_the_cause_and_the_remedy_once(
    client: Client,
) -> None:
    both = [("image", PHOTO), ("images", PHOTO)]
    for sent, cause in (
        ({"level": (None, "fmr-1e-3")}, "send at least one photo; "),
        (both, "send image or images, not both; "),
    ):
        answer = client.post("/v1/subjects/alice/verify", files=sent)
        assert_error(answer, 422, "validation_failed")
        message = answer.json()["error"]["message"]
        assert message.startswith(cause)
        assert message.count("@photo.jpg") == 1


@pytest.mark.parametrize(
    ("method", "path", "field"),
    [
        ("PUT", "/v1/subjects/alice/enrollment", "images"),
        ("POST", "/v1/subjects/alice/verify", "image"),
        ("POST", "/v1/photos/check", "image"),
    ],
)
@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [
        ({"content": PHOTO}, 400, "the body is of no known type"),
        ({"content": PHOTO, "headers": {"Content-Type": "image/png"}}, 400, "is image/png"),
        ({"data": {"image": BASE64}}, 400, "is application/x-www-form-urlencoded"),
        ({"json": {"image": BASE64}}, (422, 400), ""),
        ({"files": {"image": (None, BASE64)}}, 422, ""),
    ],
)
def test_a_photo_sent_in_the_wrong_way_is_told_the_right_one(
    client: Client,
    deployment: Deployment,
    method: str,
    path: str,
    field: str,
    sent: dict[str, Any],
    status: int | tuple[int, int],
    said: str,
) -> None:
    """In the place of `forbidden`, which would have an operator grant the right `embeddings`."""
    headers = bearer(deployment.key("enroll", "verify")) | sent.get("headers", {})
    answer = client.request(method, path, **{**sent, "headers": headers})
    message = answer.json()["error"]["message"]
    if isinstance(status, tuple):
        status = status[path.endswith("check")]
    code = {400: "malformed_request", 422: "validation_failed"}[status]
    assert_error(answer, status, code)
    assert f"-F {field}=@photo.jpg" in message
    assert said in message


def test_a_form_field_comes_once(client: Client) -> None:
    """Of two levels, readers would differ in which counts."""
    for data in ({"level": ["fmr-1e-3", "fmr-1e-2"]}, {"image": "x"}):
        sent = {"files": images(PHOTO, name="image"), "data": data}
        answer = client.post("/v1/subjects/alice/verify", **sent)
        assert_error(answer, 422, "validation_failed")
        assert "twice" in answer.json()["error"]["message"]


TOKEN = {"subject_id": "alice", "action": "verify"}


@pytest.mark.parametrize(
    ("body", "headers"),
    [
        (json.dumps(TOKEN).encode(), {"Content-Type": "text/plain"}),
        (json.dumps(TOKEN).encode(), {}),
        (json.dumps(TOKEN).encode("utf-16"), {"Content-Type": "application/json"}),
        (json.dumps(TOKEN).encode("utf-32-le"), {"Content-Type": "application/json"}),
        (PHOTO, {"Content-Type": "application/json"}),
        # Not compressed, as it says: a proxy would read something else.
        (
            json.dumps(TOKEN).encode(),
            {"Content-Type": "application/json", "Content-Encoding": "gzip"},
        ),
        (
            gzip.compress(json.dumps(TOKEN).encode(), mtime=0),
            {"Content-Type": "application/json", "Content-Encoding": "gzip"},
        ),
    ],
)
def test_json_is_utf8_and_says_that_it_is_json(
    client: Client, body: bytes, headers: dict[str, str]
) -> None:
    assert_error(client.post("/v1/tokens", content=body, headers=headers), 400, "malformed_request")


def test_a_charset_changes_nothing(client: Client) -> None:
    answer = client.post(
        "/v1/tokens",
        content=json.dumps(TOKEN).encode(),
        headers={"Content-Type": "Application/JSON; charset=UTF-8"},
    )
    assert answer.status_code == 201


def test_text_that_utf8_cannot_carry(client: Client) -> None:
    for labels in ('{"race": "\\ud800"}', '{"gender": "\\u0000"}', '{"gender": "a\\nb"}'):
        answer = client.put(
            "/v1/subjects/surrogate/enrollment",
            files=images(photo(1)),
            data={"attributes": labels},
        )
        assert_error(answer, 422, "validation_failed")
    answer = client.post(
        "/v1/subjects/a/verify",
        content=b'{"embedding": [1.0], "level": "\\ud800"}',
        headers={"Content-Type": "application/json"},
    )
    assert_error(answer, 422, "validation_failed")


def test_a_key_that_is_not_ascii(client: Client) -> None:
    for value in (b"Bearer \xff\xfe", "Bearer ключ".encode()):
        answer = client.get("/v1/contract", headers={"Authorization": value})
        assert_error(answer, 401, "unauthorized")
    assert client.get("/v1/contract", headers=bearer("vf_x")).status_code == 401
