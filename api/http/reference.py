"""The API reference: one HTML page, written from the OpenAPI document, without a script."""

import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from api.http.openapi import DESCRIPTION

SAMPLES = "x-codeSamples"
CURL: Mapping[str, str] = {
    "getOwnKey": 'curl -H "$AUTH" $URL/v1/key',
    "getContract": 'curl -H "$AUTH" -o contract.json $URL/v1/contract',
    "getGenerator": 'curl -H "$AUTH" -o generator.veil $URL/v1/contract/generator',
    "createToken": 'curl -H "$AUTH" -H "Content-Type: application/json" \\\n'
    """  -d '{"subject_id": "alice", "action": "verify"}' $URL/v1/tokens""",
    "checkPhoto": 'curl -H "$AUTH" -F image=@alice-1.jpg $URL/v1/photos/check',
    "enroll": 'curl -X PUT -H "$AUTH" -H "If-None-Match: *" \\\n'
    "  -F images=@alice-1.jpg -F images=@alice-2.jpg $URL/v1/subjects/alice/enrollment",
    "listSubjects": 'curl -H "$AUTH" "$URL/v1/subjects?limit=10"',
    "getSubject": 'curl -H "$AUTH" $URL/v1/subjects/alice',
    "verify": 'curl -H "$AUTH" -F image=@alice-3.jpg $URL/v1/subjects/alice/verify',
    "exportSubject": 'curl -H "$AUTH" -o export.json $URL/v1/subjects/alice/export',
    "importSubject": "python3 -c \"import json; e = json.load(open('export.json'))['export']; "
    "print(json.dumps({'export': e}))\" |\n"
    '  curl -H "$AUTH" -H "Content-Type: application/json" --data @- $URL/v1/subjects/import',
    "getLockout": 'curl -H "$AUTH" $URL/v1/subjects/alice/lockout',
    "unlockSubject": 'curl -X DELETE -H "$AUTH" $URL/v1/subjects/alice/lockout',
    "eraseSubject": 'curl -X DELETE -H "$AUTH" -o receipt.json $URL/v1/subjects/alice',
    "live": "curl $URL/health/live",
    "ready": "curl $URL/health/ready",
    "metrics": "curl $URL/metrics",
}
"""A call by operation id. `$URL` is the service, `$AUTH` is `Authorization: Bearer KEY`."""


def operation_id(route: APIRoute) -> str:
    """Name an operation after its function: ``erase_subject`` is ``eraseSubject``."""
    first, *rest = route.name.split("_")
    return first + "".join(word.capitalize() for word in rest)


class DescribedApi(FastAPI):
    """An application whose OpenAPI document is there before a request asks for it."""

    def __init__(self, document: dict[str, Any], **options: Any) -> None:
        super().__init__(**options)
        self._document = document

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        return self._document


def describe(routes: Sequence[BaseRoute], *, version: str) -> dict[str, Any]:
    """Make the OpenAPI document of routes, with the calls of :data:`CURL`."""
    document = get_openapi(
        title="Veilface", version=version, description=DESCRIPTION, routes=routes
    )
    for entry in document["paths"].values():
        for operation in entry.values():
            if source := CURL.get(operation["operationId"]):
                operation[SAMPLES] = [{"lang": "Shell", "source": source}]
    return document


def render(document: Mapping[str, Any]) -> str:
    """Return the page of an OpenAPI document; every text of it is escaped."""
    operations = [
        (method.upper(), path, operation)
        for path, entry in document["paths"].items()
        for method, operation in entry.items()
    ]
    contents = "".join(
        f'<li><a href="#{escape(operation["operationId"])}"><code>{method}</code> '
        f"{escape(path)}</a> {_line(operation['summary'])}</li>"
        for method, path, operation in operations
    )
    sections = "".join(_operation(document, *operation) for operation in operations)
    info = document["info"]
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<title>Veilface API</title><link rel="stylesheet" href="/docs/reference.css"></head><body>'
        f"<main><h1>Veilface API {escape(info['version'])}</h1>{_text(info['description'])}"
        '<p>The same as <a href="/v1/openapi.json">OpenAPI document</a>. In the examples '
        "<code>$URL</code> is this service, and <code>$AUTH</code> is "
        "<code>Authorization: Bearer KEY</code>.</p>"
        f"<nav><ul>{contents}</ul></nav>{sections}</main></body></html>"
    )


def _operation(
    document: Mapping[str, Any], method: str, path: str, operation: Mapping[str, Any]
) -> str:
    parameters = [
        (
            f"<code>{escape(each['name'])}</code> ({escape(each['in'])})",
            _line(each.get("description", "")),
        )
        for each in operation.get("parameters", ())
    ]
    bodies = operation.get("requestBody", {}).get("content", {})
    parts = [
        f'<section id="{escape(operation["operationId"])}">',
        f"<h2><code>{method}</code> {escape(path)}</h2><p><strong>{_line(operation['summary'])}"
        f"</strong> <code>{escape(operation['operationId'])}</code></p>",
        _text(operation["description"]),
        *(f"<pre>{escape(sample['source'])}</pre>" for sample in operation.get(SAMPLES, ())),
        _table("Parameters", parameters),
    ]
    for kind, body in bodies.items():
        parts.append(_table(f"Body: {kind}", _fields(document, body["schema"])))
    for status, response in operation["responses"].items():
        if int(status) < 400:
            for kind, body in response.get("content", {}).items():
                title = f"Answer {status}: {kind}"
                parts.append(_table(title, _fields(document, body.get("schema", {}))))
    errors = [
        (f"{status} <code>{escape(code)}</code>", _line(example["value"]["error"]["message"]))
        for status, response in operation["responses"].items()
        for body in response.get("content", {}).values()
        for code, example in body.get("examples", {}).items()
        if int(status) >= 400
    ]
    return "".join([*parts, _table("Errors", errors), "</section>"])


def _fields(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield name and meaning of each property, those of objects inside below theirs."""
    schema = _resolved(document, schema)
    required = set(schema.get("required", ()))
    for name, entry in schema.get("properties", {}).items():
        kind = _kind(document, entry)
        needed = "" if name in required else ", optional"
        text = _line(entry.get("description") or _resolved(document, entry).get("description", ""))
        yield f"<code>{escape(name)}</code> ({escape(kind)}{needed})", text
        inner = _resolved(document, entry.get("items", entry))
        for inside, meaning in _fields(document, inner) if "properties" in inner else ():
            yield f"<code>{escape(name)}</code> › {inside}", meaning


def _resolved(document: Mapping[str, Any], schema: Mapping[str, Any]) -> Mapping[str, Any]:
    if "$ref" not in schema:
        return schema
    name = schema["$ref"].rsplit("/", 1)[1]
    resolved: Mapping[str, Any] = document["components"]["schemas"][name]
    return resolved


def _kind(document: Mapping[str, Any], schema: Mapping[str, Any]) -> str:
    if "anyOf" in schema:
        return " or ".join(_kind(document, each) for each in schema["anyOf"])
    schema = _resolved(document, schema)
    if "enum" in schema or "const" in schema:
        return " or ".join(map(str, schema.get("enum", [schema.get("const")])))
    if schema.get("type") == "array":
        return f"list of {_kind(document, schema.get('items', {}))}"
    return str(schema.get("format") or schema.get("type", "any"))


def _table(title: str, rows: Any) -> str:
    cells = "".join(f"<tr><th scope=row>{name}</th><td>{text}</td></tr>" for name, text in rows)
    return f"<h3>{escape(title)}</h3><table>{cells}</table>" if cells else ""


def _text(text: str) -> str:
    return "".join(f"<p>{_line(part)}</p>" for part in re.split(r"\n\s*\n", text.strip()))


def _line(text: str) -> str:
    """Escape a text; what stands in backticks becomes code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(text))
