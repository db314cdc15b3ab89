"""The documentation and OpenAPI are held against the application (as datasette does)."""

import json
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from api.http.app import create_app
from api.http.errors import ERROR_CODES
from api.settings import Settings
from tests.api.client import Client

DOCS = Path(__file__).resolve().parents[3] / "docs"
PRODUCT_CALLS = {
    ("PUT", "/v1/subjects/{subject_id}/enrollment"),
    ("POST", "/v1/subjects/{subject_id}/verify"),
    ("POST", "/v1/compare"),
    ("GET", "/v1/subjects"),
    ("GET", "/v1/subjects/{subject_id}"),
    ("DELETE", "/v1/subjects/{subject_id}"),
    ("GET", "/v1/subjects/{subject_id}/export"),
    ("POST", "/v1/subjects/import"),
    ("POST", "/v1/tokens"),
    ("GET", "/v1/pack/{sha256}"),
    ("GET", "/v1/contract"),
    ("GET", "/v1/contract/generator"),
    ("GET", "/health/live"),
    ("GET", "/health/ready"),
    ("GET", "/metrics"),
}


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return create_app(Settings()).openapi()


def operations(document: dict[str, Any]) -> dict[tuple[str, str], dict[str, Any]]:
    return {
        (method.upper(), path): operation
        for path, entry in document["paths"].items()
        for method, operation in entry.items()
    }


def test_the_calls_of_the_contract_exist(document: dict[str, Any]) -> None:
    assert set(operations(document)) >= PRODUCT_CALLS


def calls_table(document: Mapping[str, Any]) -> str:
    """Write the table of calls of ``docs/rest.md``: each with what its description says first."""
    calls = [
        (f"{method.upper()} {path}", operation)
        for path, entry in document["paths"].items()
        for method, operation in entry.items()
    ]
    groups = [tag["name"] for tag in document["tags"]]
    calls.sort(key=lambda call: groups.index(call[1]["tags"][0]))
    rows = ["| call | does | right |", "|---|---|---|"]
    for name, operation in calls:
        said = operation["description"].partition(". ")[0].partition(".\n")[0].rstrip(".")
        right = " ".join(re.sub(r"^Rights?: ", "", said).split())
        rows.append(f"| `{name}` | {operation['summary']} | {right} |")
    return "\n".join(rows) + "\n"


def codes_table() -> str:
    """Write the table of error codes of ``docs/rest.md`` from the one table of codes."""
    rows = ["| status | code | meaning |", "|---|---|---|"]
    rows += [
        f"| {entry.status} | `{code}` | {entry.meaning} |" for code, entry in ERROR_CODES.items()
    ]
    return "\n".join(rows) + "\n"


@pytest.mark.parametrize("table", ["calls", "codes"])
def test_rest_md_has_the_tables(document: dict[str, Any], table: str) -> None:
    written = calls_table(document) if table == "calls" else codes_table()
    assert written in (DOCS / "rest.md").read_text(encoding="utf-8"), written


def test_every_operation_is_described(document: dict[str, Any]) -> None:
    for name, operation in operations(document).items():
        assert operation["summary"], name
        assert operation["description"], name
        assert operation["tags"], name
        assert {"200", "201"} & set(operation["responses"]), name


def test_every_operation_answers_errors_in_the_one_shape(document: dict[str, Any]) -> None:
    schemas = document["components"]["schemas"]
    assert schemas["ErrorBody"]["properties"]["code"]["enum"] == list(ERROR_CODES)
    for name, operation in operations(document).items():
        answer = operation["responses"]["default"]["content"]["application/json"]
        assert answer["schema"] == {"$ref": "#/components/schemas/ErrorAnswer"}, name
        assert {status for status in operation["responses"] if status[0] in "45"} == set(), name


def test_security_is_declared(document: dict[str, Any]) -> None:
    assert set(document["components"]["securitySchemes"]) == {"bearer"}
    for (_, path), operation in operations(document).items():
        if path.startswith("/health"):
            assert "security" not in operation
        else:
            schemes = {name for entry in operation["security"] for name in entry}
            assert schemes == {"bearer"}


def test_bodies_are_documented_with_all_their_fields(document: dict[str, Any]) -> None:
    bodies = {
        operation["operationId"]: {
            kind: set(body["schema"]["properties"])
            for kind, body in operation["requestBody"]["content"].items()
        }
        for operation in operations(document).values()
        if "requestBody" in operation
    }
    form, json_ = "multipart/form-data", "application/json"
    assert bodies == {
        "enroll": {
            form: {"images", "attributes", "face", "holder_key"},
            json_: {"template", "holder_key"},
        },
        "verify": {
            form: {"image", "images", "challenge_id", "level", "face", "holder_key"},
            json_: {"embedding", "embeddings", "template", "level", "holder_key"},
        },
        "compare": {form: {"images", "level", "face"}},
        "checkPhoto": {form: {"image", "face"}},
        "createChallenge": {json_: {"subject_id"}},
        "createToken": {json_: {"subject_id", "action", "level", "lifetime_s", "replace"}},
        "importSubject": {json_: {"export"}},
    }


def test_the_document_is_served_and_is_json(client: Client) -> None:
    answer = client.get("/v1/openapi.json", headers={"Authorization": ""})
    assert answer.status_code == 200
    assert json.loads(answer.text)["info"]["title"] == "Veilface"


def test_the_document_is_there_before_a_request_asks_for_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The framework builds it under filters for warnings, which are the whole process's."""

    class Caught:
        def __init__(self, *_args: object, **_options: object) -> None:
            raise AssertionError("filters of the process are changed while requests are answered")

    app = create_app(Settings())
    monkeypatch.setattr(warnings, "catch_warnings", Caught)
    assert "/metrics" in app.openapi()["paths"]
    app.openapi_schema = None
    with pytest.raises(AssertionError, match="filters of the process"):
        FastAPI.openapi(app)
