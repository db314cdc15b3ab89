"""One class for every error code of the service, and a sensible one for codes to come."""

import json
import re
from pathlib import Path

import httpx
import pytest
from pydantic import ValidationError

import veilface_client
from api.http.errors import ERROR_CODES
from veilface_client import errors, results
from veilface_client.errors import ServiceError, UnexpectedAnswer, error_of


def stated_classes() -> dict[str, str]:
    """The class of each code, as docs/python.md has them."""
    page = Path(__file__).resolve().parents[2] / "docs" / "python.md"
    table = page.read_text(encoding="utf-8").split("| class | codes |")[1].split("\n\n")[0]
    rows = re.findall(r"^\| `(\w+)` \| (.*) \|$", table, flags=re.MULTILINE)
    return {code: name for name, codes in rows for code in re.findall(r"`(\w+)`", codes)}


STATED = stated_classes()


def answer(status: int, body: object, **headers: str) -> httpx.Response:
    return httpx.Response(status, content=json.dumps(body).encode(), headers=headers)


def shaped(code: str) -> dict[str, object]:
    error = {"code": code, "message": "said", "details": {"limit": 3}}
    return {"error": error, "request_id": "4b1f0d5c"}


@pytest.mark.parametrize(
    ("status", "code", "kind"),
    [
        *(
            (each.status, code, STATED.get(code, "ServiceError"))
            for code, each in ERROR_CODES.items()
        ),
        (400, "later_code", "ServiceError"),
        (401, "later_code", "Unauthorized"),
        (404, "later_code", "ServiceError"),
        (423, "later_code", "LockedOut"),
        (429, "later_code", "RateLimited"),
        (502, "later_code", "Unavailable"),
    ],
)
def test_an_answer_becomes_an_error_of_the_class_that_the_page_states(
    status: int, code: str, kind: str
) -> None:
    error = error_of(answer(status, shaped(code), **{"Retry-After": "7"}))
    assert isinstance(error, ServiceError)
    assert type(error).__name__ == kind
    assert (error.code, error.status, error.message) == (code, status, "said")
    assert (error.details, error.request_id, error.retry_after) == ({"limit": 3}, "4b1f0d5c", 7.0)
    assert str(error) == f"said ({code}, request 4b1f0d5c)"


def test_the_page_states_codes_of_the_service() -> None:
    assert STATED.keys() <= ERROR_CODES.keys()


@pytest.mark.parametrize(
    "body", ["<html>vf_secret</html>", [], {"error": "x"}, {"error": {"code": 1, "message": ""}}]
)
def test_the_page_of_a_proxy_is_not_repeated(body: object) -> None:
    error = error_of(answer(502, body))
    assert isinstance(error, errors.Unavailable)
    assert error.code == "http_502"
    assert "vf_secret" not in str(error)


@pytest.mark.parametrize("header", ["Fri, 31 Dec 1999 23:59:59 GMT", "-1", "1e9", "٣", ""])
def test_a_strange_retry_after_is_none(header: str) -> None:
    error = error_of(
        httpx.Response(503, json=shaped("overloaded"), headers=[(b"Retry-After", header.encode())])
    )
    assert isinstance(error, errors.Unavailable)
    assert error.retry_after is None


def test_every_class_is_drawn_in_the_tree_and_handed_out() -> None:
    classes = {
        value
        for value in vars(errors).values()
        if isinstance(value, type) and issubclass(value, errors.VeilfaceError)
    }
    for kind in classes:
        assert kind.__name__ in (errors.__doc__ or "")
        assert getattr(veilface_client, kind.__name__) is kind


DECISION = {
    "decision": "accept",
    "reason": "match",
    "level": "fmr-1e-3",
    "fmr": 0.001,
    "contract_id": "c",
    "calibration_id": "k",
    "request_id": "r",
}


def test_fields_to_come_are_ignored_and_values_are_frozen() -> None:
    decision = results.Decision.read(answer(200, {**DECISION, "of_a_later_version": 0.9}))
    assert decision.accepted
    with pytest.raises(ValidationError, match="frozen"):
        decision.decision = "reject"


@pytest.mark.parametrize("said", ["ACCEPT", "maybe", "", None, True, 1])
def test_only_accept_is_accept(said: object) -> None:
    with pytest.raises(UnexpectedAnswer, match="decision"):
        results.Decision.read(answer(200, {**DECISION, "decision": said}))


def test_an_answer_that_does_not_fit_names_fields_and_no_value() -> None:
    with pytest.raises(UnexpectedAnswer) as unexpected:
        results.Decision.read(answer(200, {"decision": "vf_secret"}))
    assert "calibration_id" in str(unexpected.value)
    assert "vf_secret" not in str(unexpected.value)
    with pytest.raises(UnexpectedAnswer):
        results.Decision.read(httpx.Response(200, content=b"<html>"))
