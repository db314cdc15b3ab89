"""What OpenAPI says of errors and request bodies, derived from the one table of codes."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from starlette.routing import BaseRoute

from api.http.errors import ERROR_CODES
from api.http.schemas import (
    HOLDER_KEY,
    REQUEST_ID,
    ErrorAnswer,
    TemplateRequest,
    VerifyRequest,
)
from api.http.tokens import ACTIONS, LONGEST_S
from templates.keys.holder_key import PATTERN as HOLDER_KEY_PATTERN
from verify import MAX_FRAMES, MAX_PROBE_PHOTOS

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

EVERY_CALL = (
    "unauthorized",
    "rate_limited",
    "store_unavailable",
    "overloaded",
    "internal_error",
)
BODY = ("malformed_request", "request_too_large", "validation_failed")
PHOTO = (
    "unsupported_image",
    "image_too_large",
    "too_many_images",
    "no_face",
    "multiple_faces",
    "face_too_small",
    "low_quality",
    "model_unavailable",
)

CHECKED_PHOTO = ("unsupported_image", "image_too_large", "too_many_images", "model_unavailable")


class DescribedApi(FastAPI):
    """An application whose OpenAPI document is there before a request asks for it."""

    def __init__(self, document: dict[str, Any], **options: Any) -> None:
        super().__init__(**options)
        self._document = document

    def openapi(self) -> dict[str, Any]:
        """Return the OpenAPI document."""
        return self._document


def operation_id(route: APIRoute) -> str:
    """Name an operation after its function: ``erase_subject`` is ``eraseSubject``."""
    first, *rest = route.name.split("_")
    return first + "".join(word.capitalize() for word in rest)


def describe(routes: Sequence[BaseRoute], *, version: str) -> dict[str, Any]:
    """Make the OpenAPI document of routes."""
    return get_openapi(
        title="Veilface", version=version, description=DESCRIPTION, tags=[*TAGS], routes=routes
    )


def error_responses(*codes: str) -> dict[int | str, dict[str, Any]]:
    """Document the codes of one call, grouped by status, each with an example."""
    grouped: dict[int | str, dict[str, Any]] = {}
    for code in sorted(set(codes), key=list(ERROR_CODES).index):
        entry = ERROR_CODES[code]
        response = grouped.setdefault(
            entry.status,
            {
                "model": ErrorAnswer,
                "description": "",
                "content": {"application/json": {"examples": {}}},
            },
        )
        shown = f"`{code}`: {entry.meaning}"
        response["description"] = "\n\n".join(filter(None, (response["description"], shown)))
        response["content"]["application/json"]["examples"][code] = {
            "value": {
                "error": {"code": code, "message": entry.meaning, "details": {}},
                "request_id": REQUEST_ID,
            }
        }
    return grouped


def _text(description: str, **extra: Any) -> dict[str, Any]:
    return {"type": "string", "description": description, **extra}


LEVEL = _text(
    "Security level; default from the contract, or the lowest allowed.", examples=["fmr-1e-3"]
)
FACE = _text(
    "Which face counts when a photo shows several: the largest if it covers the middle of the "
    "picture and has twice the area of every other (`dominant`, the default); the largest wherever "
    "it is (`largest`), if it has 1.25 times the area; none (`single`). Otherwise the photo is "
    "refused as `multiple_faces`.",
    enum=["dominant", "largest", "single"],
)
HOLDER_KEY_FIELD = _text(
    "The holder's key: 32 random bytes, base64url.",
    pattern=HOLDER_KEY_PATTERN,
    examples=[HOLDER_KEY],
)
FILE = {"type": "string", "format": "binary"}


def _body(multipart: dict[str, Any] | None, json_body: dict[str, Any]) -> dict[str, Any]:
    content: dict[str, Any] = {"application/json": json_body}
    if multipart is not None:
        content = {"multipart/form-data": {"schema": multipart}, **content}
    return {"requestBody": {"required": True, "content": content}}


ENROLLMENT_BODY = _body(
    {
        "type": "object",
        "required": ["images"],
        "properties": {
            "images": {"type": "array", "items": FILE, "minItems": 1, "maxItems": 10},
            "attributes": _text(
                "JSON object with `gender` and `race`; used for lifting only, never stored.",
                examples=['{"gender": "Female", "race": "Indian"}'],
            ),
            "face": FACE,
            "holder_key": HOLDER_KEY_FIELD,
        },
    },
    {
        "schema": TemplateRequest.model_json_schema(),
        "examples": {"template": {"value": {"template": "kAAAAAAAAAB7Li4u"}}},
    },
)
PROBE_PHOTOS = {"type": "array", "items": FILE, "minItems": 1, "maxItems": MAX_PROBE_PHOTOS}
CHALLENGE_ID = _text(
    "`challenge_id` of POST /v1/challenges: the images are then the 5 to 12 frames that answer it.",
    maxLength=1024,
)
FRAMES = {**PROBE_PHOTOS, "maxItems": MAX_FRAMES}
CHALLENGE_BODY = _body(
    None,
    {
        "schema": {
            "type": "object",
            "properties": {
                "subject_id": {
                    "anyOf": [{"type": "string"}, {"type": "null"}],
                    "description": "The only subject that it may be answered for; left out: any.",
                    "examples": ["alice"],
                }
            },
        },
        "examples": {"subject": {"value": {"subject_id": "alice"}}},
    },
)
TOKEN_BODY = _body(
    None,
    {
        "schema": {
            "type": "object",
            "required": ["subject_id", "action"],
            "properties": {
                "subject_id": {"type": "string", "examples": ["alice"]},
                "action": {"type": "string", "enum": list(ACTIONS)},
                "level": {
                    "anyOf": [{"type": "string"}, {"type": "null"}],
                    "description": "For `verify`; left out, the one in force.",
                    "examples": ["fmr-1e-3"],
                },
                "lifetime_s": {
                    "type": "integer",
                    "minimum": 1,
                    "maximum": LONGEST_S,
                    "default": LONGEST_S,
                },
                "replace": {
                    "type": "boolean",
                    "default": True,
                    "description": "For `enroll`; false: as `If-None-Match: *`.",
                },
            },
        },
        "examples": {"verify": {"value": {"subject_id": "alice", "action": "verify"}}},
    },
)
VERIFY_BODY = _body(
    {
        "type": "object",
        "oneOf": [{"required": ["image"]}, {"required": ["images"]}],
        "properties": {
            "image": PROBE_PHOTOS,
            "images": FRAMES,
            "challenge_id": CHALLENGE_ID,
            "level": LEVEL,
            "face": FACE,
            "holder_key": HOLDER_KEY_FIELD,
        },
    },
    {
        "schema": VerifyRequest.model_json_schema(),
        "examples": {
            "embedding": {"value": {"embedding": [0.6, -0.8], "level": "fmr-1e-3"}},
            "embeddings": {"value": {"embeddings": [[0.6, -0.8], [0.8, -0.6]]}},
            "template": {"value": {"template": "kAAAAAAAAAB7Li4u"}},
        },
    },
)
CHECK_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["image"],
                    "properties": {"image": FILE, "face": FACE},
                }
            }
        },
    }
}
IMPORT_BODY = _body(
    None,
    {
        "schema": {
            "type": "object",
            "required": ["export"],
            "properties": {"export": _text("`export` of an export call.")},
        },
        "examples": {"import": {"value": {"export": "VkZYMS4uLg=="}}},
    },
)


def allowed_methods(document: Mapping[str, Any], path: str) -> list[str]:
    """Return the methods of a path, by the OpenAPI document; the framework names one route's only.

    Where two paths fit, the one that is written out is meant: `/v1/subjects/import`.
    """
    fitting = [
        template
        for template in document["paths"]
        if re.fullmatch(re.sub(r"\{[^}]*\}", "[^/]+", template), path)
    ]
    for template in sorted(fitting, key=lambda template: template.count("{")):
        return sorted(method.upper() for method in document["paths"][template])
    return []


def codes_table() -> str:
    """Write the table of ``docs/errors.md`` from the one table of codes."""
    rows = ["| status | code | meaning |", "|---|---|---|"]
    rows += [
        f"| {entry.status} | `{entry.code}` | {entry.meaning} |" for entry in ERROR_CODES.values()
    ]
    return "\n".join(rows) + "\n"
