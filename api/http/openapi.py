"""What OpenAPI says of calls, errors and request bodies, which FastAPI cannot say by itself."""

from typing import Any

from fastapi.routing import APIRoute
from pydantic import BaseModel

from api.http.schemas import ErrorAnswer

DESCRIPTION = """\
Face authentication that never stores a face embedding. Every error has one shape; the codes are
listed with every call. `X-Request-ID` is accepted, and returned in the header and in the body.
"""

TAGS = (
    {"name": "Enroll and verify"},
    {"name": "People", "description": "Who is enrolled; erase, export and import them."},
    {"name": "Tokens", "description": "What a browser holds in place of an API key."},
    {"name": "Operations", "description": "Contract, keys, audit log, health and metrics."},
)
"""Groups of calls, in the order of the reference."""

ERRORS: dict[int | str, dict[str, Any]] = {
    "default": {"model": ErrorAnswer, "description": "An error, by its code."}
}
"""What every call may answer."""


def operation_id(route: APIRoute) -> str:
    """Name an operation after its function: ``erase_subject`` is ``eraseSubject``."""
    first, *rest = route.name.split("_")
    return first + "".join(word.capitalize() for word in rest)


def body_of(
    *, form: type[BaseModel] | None = None, json: type[BaseModel] | None = None
) -> dict[str, Any]:
    """Document a body by its models: FastAPI cannot say that a call takes two content types."""
    models = {"multipart/form-data": form, "application/json": json}
    content = {
        kind: {"schema": _schema_of(model)} for kind, model in models.items() if model is not None
    }
    return {"requestBody": {"required": True, "content": content}}


def _schema_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return a model's schema with its definitions in place: OpenAPI has no room for them here."""
    schema = model.model_json_schema()
    definitions = schema.pop("$defs", {})
    for member in schema["properties"].values():
        name = member.pop("$ref", "").removeprefix("#/$defs/")
        member.update({**definitions.get(name, {}), **member})
    return schema
