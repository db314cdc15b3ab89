"""The API reference: what it says, what it is served with, and that its calls run."""

import re
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.reference import CURL, render
from api.settings import Settings
from tests.api.client import Client
from tests.api.deployment import deploy, photo
from tests.api.shapes import assert_error
from tests.clients.conftest import Running, service

__all__ = ["service"]

FIRST, LAST = "enroll", "eraseSubject"


class Elements(HTMLParser):
    """Tags and attributes of a page, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return create_app(Settings()).openapi()


def operations(document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    named = [each for entry in document["paths"].values() for each in entry.values()]
    assert len({each["operationId"] for each in named}) == len(named)
    return {each["operationId"]: each for each in named}


def test_operations_have_plain_names(document: dict[str, Any]) -> None:
    names = set(operations(document))
    assert {"enroll", "verify", "eraseSubject", "listSubjects"} <= names
    assert [name for name in names if not re.fullmatch(r"[a-z]+([A-Z][a-z]+)*", name)] == []
    assert set(CURL) <= names


def test_the_page_tells_every_operation_field_and_code(document: dict[str, Any]) -> None:
    page = Elements(render(document))
    ids = {attributes.get("id") for _, attributes in page.tags}
    links = {attributes["href"] for tag, attributes in page.tags if tag == "a"}
    for name, operation in operations(document).items():
        assert name in ids
        assert f"#{name}" in links
        for parameter in operation.get("parameters", ()):
            assert parameter["name"] in page.text
        for body in operation.get("requestBody", {}).get("content", {}).values():
            assert all(field in page.text for field in body["schema"]["properties"])
    for schema in document["components"]["schemas"].values():
        assert all(field in page.text for field in schema.get("properties", {}))


def test_the_page_needs_nothing_that_its_policy_forbids(client: Client) -> None:
    answer = client.get("/docs", headers={"Authorization": ""})
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/html; charset=utf-8")
    policy = answer.headers["content-security-policy"]
    assert "unsafe" not in policy
    assert policy.startswith("default-src 'none'; ")
    page = Elements(answer.text)
    assert {tag for tag, _ in page.tags} & {"script", "style", "img", "iframe", "form"} == set()
    for _, attributes in page.tags:
        assert not [name for name in attributes if name.startswith("on") or name == "style"]
    sheet = client.get("/docs/reference.css")
    assert sheet.headers["content-type"] == "text/css; charset=utf-8"
    assert "url(" not in sheet.text
    again = client.get("/docs", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304


def test_texts_of_the_document_are_no_markup(document: dict[str, Any]) -> None:
    evil = "<script>alert(1)</script> & `<b>`"
    entry = {**document["paths"]["/v1/key"]["get"], "summary": evil, "description": evil}
    page = render({**document, "paths": {"/v1/<i>": {"get": entry}}})
    assert "script" not in {tag for tag, _ in Elements(page).tags}
    assert evil.replace("`", "") in Elements(page).text


def test_an_operator_switches_it_off(tmp_path: Path) -> None:
    with Client(create_app(deploy(tmp_path, api_docs=False).settings)) as client:
        for path in ("/docs", "/docs/reference.css"):
            assert_error(client.get(path), 404, "not_found")


def test_every_call_of_the_document_runs(
    document: dict[str, Any], service: Running, tmp_path: Path
) -> None:
    """In the order of the page, but for what comes first and last."""
    for shot in range(3):
        (tmp_path / f"alice-{shot + 1}.jpg").write_bytes(photo(1, shot))
    samples = {
        name: operation["x-codeSamples"][0]["source"]
        for name, operation in operations(document).items()
        if "x-codeSamples" in operation
    }
    assert set(samples) == set(CURL)
    rejected = f'curl -H "$AUTH" -F image=@{tmp_path / "other.jpg"} $URL/v1/subjects/alice/verify'
    (tmp_path / "other.jpg").write_bytes(photo(2, 0))
    steps = [samples.pop(FIRST), rejected]
    last = samples.pop(LAST)
    # An import takes what was exported before, and the lockout has something to tell.
    first = ("getLockout", "exportSubject", "importSubject")
    steps += [*(samples.pop(name) for name in first), *samples.values(), last]
    script = 'curl() { command curl --silent --show-error --fail-with-body "$@"; }\n'
    env = {
        "PATH": "/usr/local/bin:/usr/bin:/bin",
        "URL": service.url,
        "AUTH": f"Authorization: Bearer {service.deployment.token}",
    }
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script + "\necho\n".join(steps)],
        cwd=tmp_path, env=env, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert '"decision":"accept"' in done.stdout
    assert {"contract.json", "generator.veil", "export.json", "receipt.json"} <= {
        path.name for path in tmp_path.iterdir()
    }
