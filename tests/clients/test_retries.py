"""When a call is sent again, and that a write which is sent again is done once."""

import asyncio
import types
from collections.abc import Callable

import httpx
import pytest

import veilface_client.async_client
import veilface_client.client
from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.clients.proxy import Proxy
from veilface_client import (
    AsyncClient,
    Client,
    ConnectionFailed,
    LockedOut,
    Retries,
    ServiceError,
    Unavailable,
    VeilfaceError,
)

URL, TOKEN = "http://service.test", f"vf_{'0' * 12}_{'0' * 64}"
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
    "fmr": 0.1,
    "contract_id": "c",
    "calibration_id": "k",
    "request_id": "r",
}
Step = tuple[int, str | None, str | None] | type[Exception]
"""Status, error code and Retry-After of an answer; or what breaks instead."""


class Script:
    """A service that answers as it was told, then well."""

    def __init__(self, steps: list[Step], success: object) -> None:
        self.steps, self.success = list(steps), success
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        request.read()
        self.requests.append(request)
        if not self.steps:
            return httpx.Response(200, json=self.success)
        step = self.steps.pop(0)
        if isinstance(step, type):
            raise step("broken")
        status, code, after = step
        headers = {} if after is None else {"Retry-After": after}
        if code is None:
            return httpx.Response(status, text="<html>", headers=headers)
        error = {"error": {"code": code, "message": "m", "details": {}}, "request_id": "r"}
        return httpx.Response(status, json=error, headers=headers)


@pytest.fixture
def waits(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The pauses that a client would have made."""
    made: list[float] = []

    async def pause(seconds: float) -> None:
        made.append(seconds)

    clock = types.SimpleNamespace(sleep=made.append)
    monkeypatch.setattr(veilface_client.client, "time", clock)
    monkeypatch.setattr(
        veilface_client.async_client,
        "asyncio",
        types.SimpleNamespace(
            sleep=pause, to_thread=asyncio.to_thread, CancelledError=asyncio.CancelledError
        ),
    )
    return made


def enroll(script: Script, retries: Retries) -> object:
    with Client(URL, TOKEN, retries=retries, transport=httpx.MockTransport(script)) as client:
        return client.enroll("anna", b"photo")


def enroll_once(script: Script, retries: Retries) -> object:
    """Refused where its own first sending went through: not sent again when that is unknown."""
    with Client(URL, TOKEN, retries=retries, transport=httpx.MockTransport(script)) as client:
        return client.enroll("anna", b"photo", replace=False)


def verify(script: Script, retries: Retries) -> object:
    with Client(URL, TOKEN, retries=retries, transport=httpx.MockTransport(script)) as client:
        return client.verify("anna", b"photo")


def enroll_asynchronously(script: Script, retries: Retries) -> object:
    async def scenario() -> object:
        transport = httpx.MockTransport(script)
        async with AsyncClient(URL, TOKEN, retries=retries, transport=transport) as client:
            return await client.enroll("anna", b"photo")

    return asyncio.run(scenario())


OVERLOADED: Step = (503, "overloaded", "1")
LIMITED: Step = (429, "rate_limited", "1")
STORE: Step = (503, "store_unavailable", "5")
GATEWAY: Step = (502, None, None)


@pytest.mark.parametrize(
    ("step", "write_again", "verification_again"),
    [
        (httpx.ConnectError, True, True),
        (httpx.ConnectTimeout, True, True),
        (OVERLOADED, True, True),
        (LIMITED, True, True),
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
def test_what_is_sent_again(
    step: Step, write_again: bool, verification_again: bool, waits: list[float]
) -> None:
    cases: list[tuple[Callable[[Script, Retries], object], object, bool]] = [
        (enroll, ENROLLED, write_again),
        (enroll_asynchronously, ENROLLED, write_again),
        (verify, DECIDED, verification_again),
        (enroll_once, ENROLLED, verification_again),
    ]
    for call, success, again in cases:
        script = Script([step], success)
        waits.clear()
        if again:
            assert call(script, Retries())
            assert len(script.requests) == 2
            assert len(waits) == 1
        else:
            with pytest.raises(VeilfaceError) as failed:
                call(script, Retries())
            assert len(script.requests) == 1
            assert waits == []
            assert failed.value.__suppress_context__


def test_sendings_are_bounded_and_waits_grow_with_jitter(waits: list[float]) -> None:
    script = Script([GATEWAY] * 9, ENROLLED)
    with pytest.raises(Unavailable):
        enroll(script, Retries(sendings=6, first_s=1.0, longest_s=4.0))
    assert len(script.requests) == 6
    assert all(0 <= wait <= most for wait, most in zip(waits, [1, 2, 4, 4, 4], strict=True))
    assert len(set(waits)) == 5
    script = Script([OVERLOADED], ENROLLED)
    with pytest.raises(Unavailable):
        enroll(script, Retries(sendings=1))


def test_the_service_is_waited_for_as_long_as_it_says(waits: list[float]) -> None:
    enroll(Script([(429, "rate_limited", "7"), STORE], ENROLLED), Retries(first_s=0.5))
    assert 7 <= waits[0] <= 7.5
    assert 5 <= waits[1] <= 6


def test_ready_is_asked_once(waits: list[float]) -> None:
    script = Script([OVERLOADED], {"status": "ok", "request_id": "r"})
    with (
        Client(URL, TOKEN, transport=httpx.MockTransport(script)) as client,
        pytest.raises(Unavailable),
    ):
        client.ready()
    assert len(script.requests) == 1


def test_an_enrollment_whose_answer_was_lost_is_sent_again(service: Running, token: str) -> None:
    """The service has committed when the proxy loses its answer."""
    with (
        Proxy(service.port) as proxy,
        Client(proxy.url, token, retries=Retries(first_s=0.01)) as client,
    ):
        proxy.lose = 1
        enrolled = client.enroll("once", photo(20))
        assert proxy.sent.count(b"PUT /v1/subjects/once/enrollment") == 2
        assert enrolled.replaced
        assert client.describe("once").template_id == enrolled.template_id


def test_an_erasure_whose_answer_was_lost_has_its_receipt(service: Running, token: str) -> None:
    with (
        Proxy(service.port) as proxy,
        Client(proxy.url, token, retries=Retries(first_s=0.01)) as client,
    ):
        client.enroll("gone", photo(21))
        proxy.lose = 1
        receipt = client.erase("gone")
        assert proxy.sent.count(b"DELETE /v1/subjects/gone") == 2
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


def test_nobody_listens(waits: list[float]) -> None:
    with Client("http://127.0.0.1:9", TOKEN) as client, pytest.raises(ConnectionFailed) as failed:
        client.verify("anna", photo(1))
    assert not failed.value.sent
    assert len(waits) == Retries().sendings - 1
    assert not isinstance(failed.value, ServiceError)


@pytest.mark.parametrize(
    "wrong", [{"sendings": 0}, {"first_s": -1.0}, {"longest_s": -1.0}, {"patience_s": -1.0}]
)
def test_impossible_retries_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="retries"):
        Retries(**wrong)  # type: ignore[arg-type]
