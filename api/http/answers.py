"""Answers: JSON with a request id, and the one shape of errors."""

import json
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

from api.http.errors import ApiError
from models.demo import DEMO_NOTICE


class JsonAnswer(Response):
    """JSON in ASCII, without NaN: any text that reached it can be sent."""

    media_type = "application/json"

    def render(self, content: Any) -> bytes:
        """Return the body's bytes."""
        return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


def common(request: Request) -> dict[str, Any]:
    """Return what every answer says: the request's id, and with the demo model a notice."""
    demo = request.app.state.settings.demo
    return {"request_id": request.state.request_id, "notice": DEMO_NOTICE if demo else None}


def has_copy(request: Request, etag: str) -> bool:
    """Whether `If-None-Match` says that the client has what this `ETag` names."""
    tags = request.headers.get("if-none-match", "").split(",")
    return bool({tag.strip().removeprefix("W/") for tag in tags} & {etag, "*"})


def error_answer(error: ApiError, request_id: str) -> JsonAnswer:
    """Return an error in the one shape."""
    body = {
        "error": {"code": error.code, "message": error.message, "details": dict(error.details)},
        "request_id": request_id,
    }
    return JsonAnswer(body, status_code=error.status, headers=dict(error.headers))
