"""The shapes that every answer must have."""

from typing import Any

from pydantic import BaseModel

from api.http.errors import ERROR_CODES
from api.http.schemas import ErrorAnswer


def assert_error(answer: Any, status: int, code: str) -> dict[str, Any]:
    """Hold an error against the one shape; return its details."""
    assert (answer.status_code, answer.json()["error"]["code"]) == (status, code), answer.text
    assert ERROR_CODES[code].status == status
    body = ErrorAnswer.model_validate(answer.json())
    assert body.request_id == answer.headers["x-request-id"]
    assert answer.headers["content-type"] == "application/json"
    assert body.error.message
    if status == 503:
        assert int(answer.headers["retry-after"]) > 0
    return body.error.details


def assert_answer(answer: Any, status: int, shape: type[BaseModel]) -> dict[str, Any]:
    """Hold a success against its schema; return its body."""
    assert answer.status_code == status, answer.text
    body: dict[str, Any] = answer.json()
    shape.model_validate(body)
    assert body["request_id"] == answer.headers["x-request-id"]
    return body
