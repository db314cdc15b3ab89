"""When a call is sent again, and that a write which is sent again is done once."""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import httpx
import pytest

from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.clients.proxy import Proxy
from veilface_client import Client, ConnectionFailed, LockedOut, Retries, VeilfaceError
from veilface_client.calls import Channel, PhotoCalls

Call = Callable[[PhotoCalls], Coroutine[Any, Any, object]]

ENROLLED = {
    "template_id": "t",
    "contract_id": "c",
    "replaced": False,
    "images": [],
    "request_id": "r",
}
DECIDED = {
    "decision": "accept",
    "reason": "match",
    "level": "l",
    "contract_id": "c",
    "calibration_id": "k",
    "request_id": "r",
}
Step = tuple[int, str | None, str | None] | type[Exception]
"""Status, error code and Retry-After of an answer; or what breaks instead."""
OVERLOADED: Step = (503, "overloaded", "1")
STORE: Step = (503, "store_unavailable", "5")
GATEWAY: Step = (502, None, None)


def answer(step: Step, content: dict[str, Any]) -> httpx.Response:
    if isinstance(step, type):
        raise step("broken")
    status, code, after = step
    headers = {} if after is None else {"Retry-After": after}
    if status == 200:
        return httpx.Response(200, json=content)
    if code is None:
        return httpx.Response(status, text="<html>", headers=headers)
    error = {"error": {"code": code, "message": "m", "details": {}}, "request_id": "r"}
    return httpx.Response(status, json=error, headers=headers)


class Script:
    """Gives these answers, then a good one; keeps how long it was told to wait."""

    def __init__(self, steps: list[Step], content: dict[str, Any]) -> None:
        self.script = iter(steps)
        self.content = content
        self.sendings = 0
        self.waits: list[float] = []

    async def request(self, *_: str, **__: Any) -> httpx.Response:
        self.sendings += 1
        return answer(next(self.script, (200, None, None)), self.content)

    async def sleep(self, seconds: float) -> None:
        self.waits.append(seconds)


def driven(
    call: Call, steps: list[Step], content: dict[str, Any], retries: Retries
) -> tuple[int, list[float], Exception | None]:
    """Run a call through these answers, then a good one: sendings, pauses, and its error."""
    script = Script(steps, content)
    channel = Channel(script.request, script.sleep, asyncio.to_thread)
    error = None
    try:
        asyncio.run(call(PhotoCalls(channel, retries)))
    except VeilfaceError as raised:
        error = raised
    return script.sendings, script.waits, error


def enroll(calls: PhotoCalls) -> Coroutine[Any, Any, object]:
    return calls.enroll("anna", b"photo")


def enroll_if_new(calls: PhotoCalls) -> Coroutine[Any, Any, object]:
    return calls.enroll("anna", b"photo", replace=False)


def verify(calls: PhotoCalls) -> Coroutine[Any, Any, object]:
    return calls.verify("anna", b"photo")


@pytest.mark.parametrize(
    ("step", "write_again", "verification_again"),
    [
        (httpx.ConnectError, True, True),
        (httpx.ConnectTimeout, True, True),
        (OVERLOADED, True, True),
        ((429, "rate_limited", "1"), True, True),
        (httpx.ReadError, True, False),
        (httpx.ReadTimeout, True, False),
        (httpx.WriteError, True, False),
        (httpx.RemoteProtocolError, True, False),
        (STORE, True, False),
        (GATEWAY, True, False),
        ((504, None, None), True, False),
        ((503, "model_unavailable", "5"), False, False),
        ((500, "internal_error", None), False, False),
        ((423, "locked_out", "1"), False, False),
        ((409, "enrollment_conflict", None), False, False),
        ((422, "no_face", None), False, False),
        ((401, "unauthorized", None), False, False),
        ((503, "overloaded", "31"), False, False),
    ],
)
def test_what_is_sent_again(step: Step, write_again: bool, verification_again: bool) -> None:
    cases: list[tuple[Call, dict[str, Any], bool]] = [
        (enroll, ENROLLED, write_again),
        (enroll_if_new, ENROLLED, verification_again),
        (verify, DECIDED, verification_again),
    ]
    for call, content, again in cases:
        sendings, waits, error = driven(call, [step], content, Retries())
        assert (sendings, len(waits)) == ((2, 1) if again else (1, 0))
        assert (error is None) is again
        assert error is None or error.__suppress_context__
        if isinstance(error, ConnectionFailed):
            assert error.sent


def test_readiness_is_asked_once() -> None:
    sendings, waits, error = driven(PhotoCalls.ready, [STORE], {"status": "ok"}, Retries())
    assert (sendings, waits, type(error).__name__) == (1, [], "Unavailable")


def test_sendings_are_bounded_and_waits_grow_with_jitter() -> None:
    patient = Retries(sendings=7, patience_s=2.0)
    sendings, waits, error = driven(enroll, [GATEWAY] * 9, ENROLLED, patient)
    assert (sendings, type(error).__name__) == (7, "Unavailable")
    bounds = [0.25, 0.5, 1, 2, 2, 2]
    assert all(0 <= wait <= most for wait, most in zip(waits, bounds, strict=True))
    assert len(set(waits)) == 6
    assert driven(enroll, [OVERLOADED], ENROLLED, Retries(sendings=1))[0] == 1


def test_the_service_is_waited_for_as_long_as_it_says() -> None:
    steps: list[Step] = [(429, "rate_limited", "7"), STORE]
    _, waits, _ = driven(enroll, steps, ENROLLED, Retries())
    assert 7 <= waits[0] <= 7.25
    assert 5 <= waits[1] <= 5.5


def test_a_write_whose_answer_was_lost_is_sent_again(service: Running, token: str) -> None:
    """The service has committed when the proxy loses its answer."""
    with Proxy(service.port) as proxy, Client(proxy.url, token) as client:
        proxy.lose = 1
        enrolled = client.enroll("once", photo(20))
        assert proxy.sent.count(b"PUT /v1/subjects/once/enrollment") == 2
        assert enrolled.replaced
        assert client.describe("once").template_id == enrolled.template_id
        proxy.lose = 1
        receipt = client.erase("once")
        assert proxy.sent.count(b"DELETE /v1/subjects/once") == 2
    assert receipt.held


def test_a_verification_whose_answer_was_lost_counts_once(service: Running, token: str) -> None:
    with Client(service.url, token) as direct:
        direct.enroll("hans", photo(22))
        with Proxy(service.port) as proxy, Client(proxy.url, token) as client:
            proxy.lose = 1
            with pytest.raises(ConnectionFailed) as failed:
                client.verify("hans", photo(23))
            assert failed.value.sent
        assert direct.lockout("hans").consecutive_failures == 1
        for _ in range(4):
            direct.verify("hans", photo(23))
        with pytest.raises(LockedOut):
            direct.verify("hans", photo(22))
        direct.erase("hans")
