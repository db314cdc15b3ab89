import tempfile
import threading
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack

import anyio
import anyio.from_thread
import httpx
import pytest
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Message, Receive, Scope, Send

from api.http import bodies
from api.http.bodies import MAX_FIELD_BYTES, MAX_JSON_PARTS, read_json
from api.http.context import RequestContext
from api.http.errors import ApiError
from api.http.requests import EnrollmentJson
from api.limits.admission import MAX_JSON_BYTES, Gate
from models.decoding import MAX_BYTES
from tests.api.client import Client
from tests.api.deployment import Deployment, images, photo
from tests.api.shapes import assert_error
from tests.patience import PATIENCE_S

ENROLL, VERIFY = "/v1/subjects/limits/enrollment", "/v1/subjects/limits/verify"
FORM = "multipart/form-data"
MIB = 1024 * 1024
JSON = [(b"content-type", b"application/json")]


def padded(size: int) -> bytes:
    """A picture of exactly this many bytes: a decoder stops at the end of the PNG."""
    data = photo(1)
    return data + b"\x00" * (size - len(data))


@pytest.mark.parametrize("length", [str(10**9), "9" * 50])
@pytest.mark.parametrize(
    ("method", "path"), [("PUT", ENROLL), ("POST", VERIFY), ("POST", "/v1/subjects/import")]
)
def test_declared_length_is_refused_before_the_body_is_read(
    client: Client, method: str, path: str, length: str
) -> None:
    headers = {"Content-Length": length, "Content-Type": "application/json"}
    answer = client.request(method, path, content=b"{}", headers=headers)
    assert_error(answer, 413, "request_too_large")


@pytest.mark.parametrize("kind", ["application/json", "multipart/form-data; boundary=b"])
def test_a_chunked_body_is_counted_while_it_comes(
    client: Client, deployment: Deployment, kind: str
) -> None:
    sent = 0

    async def chunks() -> AsyncIterator[bytes]:
        nonlocal sent
        yield b'--b\r\nContent-Disposition: form-data; name="x"; filename="f"\r\n\r\n'
        for _ in range(200):
            sent += 1
            yield b"\x00" * MIB

    answer = client.post(VERIFY, content=chunks(), headers={"Content-Type": kind})
    assert_error(answer, 413, "request_too_large")


def test_json_has_a_limit_of_its_own(client: Client) -> None:
    body = b'{"template": "' + b"A" * MAX_JSON_BYTES + b'"}'
    answer = client.put(ENROLL, content=body, headers={"Content-Type": "application/json"})
    assert assert_error(answer, 413, "request_too_large") == {"limit_bytes": MAX_JSON_BYTES}


def test_an_image_may_be_as_large_as_the_limit_and_no_larger(
    client: Client,
) -> None:
    limit = MAX_BYTES
    fits = client.put(ENROLL, files=images(padded(limit)))
    assert fits.status_code in (200, 201)
    larger = client.put(ENROLL, files=images(photo(1), padded(limit + 1)))
    assert assert_error(larger, 413, "image_too_large") == {"image": 1}


def test_eleven_images_are_too_many(client: Client) -> None:
    answer = client.put(ENROLL, files=images(*[photo(1)] * 11))
    assert assert_error(answer, 413, "too_many_images") == {"limit": 10}
    assert client.put(ENROLL, files=images(*[photo(1, i) for i in range(10)])).status_code == 200


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"--b\r\n",
        b"no boundary at all",
        b'--b\r\nContent-Disposition: form-data; name="images"; filename="f"\r\n\r\nabc',
        b'--b\r\nContent-Disposition: form-data; name="images"; filename="f"\r\n\r\nabc\r\n'
        b'--b\r\nContent-Disposition: form-data; name="images"; filename="g"\r\n\r\nab',
        b"--b\r\nContent-Disposition: form-data\r\n\r\nx\r\n--b--\r\n",
        b"--b\r\n\r\nx\r\n--b--\r\n",
        b"--b\r\nX: " + b"y" * 100_000 + b"\r\n\r\nx\r\n--b--\r\n",
        b"--b\r\n" + b"X: y\r\n" * 1000 + b"\r\nx\r\n--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="face"\r\n\r\n'
        + b"x" * (MAX_FIELD_BYTES + 1)
        + b"\r\n--b--\r\n",
        b'--b\r\nContent-Disposition: form-data; name="a"\r\n\r\nx\r\n' * 17 + b"--b--\r\n",
    ],
)
def test_broken_multipart_is_malformed(client: Client, body: bytes) -> None:
    answer = client.put(ENROLL, content=body, headers={"Content-Type": f"{FORM}; boundary=b"})
    code = answer.json()["error"]["code"]
    assert_error(answer, 422 if code == "validation_failed" else 400, code)
    assert code in ("malformed_request", "validation_failed")


@pytest.mark.parametrize("kind", [FORM, f"{FORM}; boundary=", f"{FORM}; charset=x"])
def test_multipart_without_a_boundary_is_malformed(client: Client, kind: str) -> None:
    answer = client.put(ENROLL, content=b"--b--", headers={"Content-Type": kind})
    assert_error(answer, 400, "malformed_request")


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", b"1", b"null", b'"x"', b"\xff\xfe", b"[" * 100_000, b'{"a":' * 50_000,
     b'{"embedding": [NaN]}', b'{"embedding": [-Infinity]}',
     b'{"embedding": [1' + b"0" * 5000 + b"]}", b'{"level":"fmr-1e-3","level":"fmr-1e-2"}',
     b'{"template":"","template":""}', b'{"export": [{"a": 1, "\\u0061": 1}]}'],
)  # fmt: skip
def test_broken_json_is_malformed(client: Client, body: bytes) -> None:
    answer = client.post(VERIFY, content=body, headers={"Content-Type": "application/json"})
    assert_error(answer, 400, "malformed_request")


def test_no_photo_is_ever_written_to_a_file(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    for name in ("TemporaryFile", "NamedTemporaryFile", "mkstemp", "_mkstemp_inner"):
        original = getattr(tempfile, name)
        monkeypatch.setattr(
            tempfile, name, lambda *a, _of=original, **k: made.append(_of) or _of(*a, **k)
        )
    control = tempfile.SpooledTemporaryFile(max_size=MIB)  # noqa: SIM115
    control.write(b"\x00" * (2 * MIB))
    control.close()
    assert made, "the control must be seen"
    made.clear()
    answer = client.put(ENROLL, files=images(*[padded(3 * MIB) for _ in range(9)]))
    assert answer.status_code in (200, 201)
    assert client.post(VERIFY, files=images(padded(9 * MIB), name="image")).status_code == 200
    assert made == []


def test_a_body_that_does_not_arrive_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bodies, "BODY_TIMEOUT_S", 0.05)

    async def never() -> None:
        async def receive() -> dict[str, object]:
            await anyio.sleep(60)
            return {}

        request = Request({"type": "http", "headers": JSON}, receive)
        with pytest.raises(ApiError, match="did not arrive") as caught:
            await read_json(request, EnrollmentJson)
        assert caught.value.code == "malformed_request"

    anyio.run(never)


async def fill(gate: Gate, key: str, inside: AsyncExitStack) -> int:
    """Take places until there is none for this key."""
    for taken in range(100):
        try:
            await inside.enter_async_context(gate.admitted(key))
        except ApiError as refusal:
            if (refusal.code, refusal.headers) == ("overloaded", {"Retry-After": "1"}):
                return taken
            raise
    raise AssertionError("there is no bound")


def test_one_key_takes_half_of_the_places_and_gives_them_back() -> None:
    async def scenario() -> None:
        gate = Gate(slots=2, waiting=36)
        for _ in range(2):
            async with AsyncExitStack() as inside:
                assert [await fill(gate, key, inside) for key in "aabc"] == [20, 0, 20, 0]

    anyio.run(scenario)


def test_a_client_that_takes_no_answer_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("api.http.context.SEND_TIMEOUT_S", 0.05)
    answered: list[str] = []

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        await Response(b"x")(scope, receive, send)
        answered.append("all of it")

    async def never(_: Message | None = None) -> Message:
        await anyio.sleep_forever()
        return {}

    async def scenario() -> None:
        scope: Scope = {"type": "http", "method": "GET", "path": "/health/live", "headers": []}
        with anyio.fail_after(PATIENCE_S):
            await RequestContext(app)(scope, never, never)  # type: ignore[arg-type]

    anyio.run(scenario)
    assert answered == []


def test_the_queue_for_the_database_has_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("api.limits.admission.MAX_WAITING_QUERIES", 3)
    go_on = threading.Event()
    outcomes: list[str] = []

    async def ask(gate: Gate) -> None:
        try:
            await gate.query(lambda: go_on.wait(PATIENCE_S))
        except ApiError as error:
            outcomes.append(f"{error.code}, retry after {error.headers['Retry-After']}")
        else:
            outcomes.append("answered")

    async def scenario() -> None:
        gate = Gate(slots=1, waiting=1)  # four may ask at the same time
        async with anyio.create_task_group() as group:
            for _ in range(10):
                group.start_soon(ask, gate)
            while len(outcomes) < 3:
                await anyio.sleep(0.01)
            assert outcomes == ["overloaded, retry after 1"] * 3
            go_on.set()
        await ask(gate)

    with anyio.from_thread.start_blocking_portal() as portal:
        portal.start_task_soon(scenario).result(timeout=PATIENCE_S)
    assert Counter(outcomes) == {"overloaded, retry after 1": 3, "answered": 8}


def test_overload_is_an_answer(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client.app.state.gate, "admitted", Gate(slots=1, waiting=-1).admitted)
    for answer in (
        client.put(ENROLL, files=images(photo(1))),
        client.post(VERIFY, json={"embedding": [1.0]}),
        client.post("/v1/subjects/import", json={"export": ""}),
    ):
        assert isinstance(answer, httpx.Response)
        assert_error(answer, 503, "overloaded")


@pytest.mark.parametrize("unit", [b'{"":0},', b"[],", b"1.5,"])
def test_a_body_of_more_values_than_any_request_has_is_refused(client: Client, unit: bytes) -> None:
    """Small values take up to thirty times the memory of their text."""
    body = b'{"embedding":[' + unit * ((MAX_JSON_BYTES - 30) // len(unit)) + b"0]}"
    answer = client.post(VERIFY, content=body, headers={"Content-Type": "application/json"})
    assert_error(answer, 400, "malformed_request")
    assert f"more than {MAX_JSON_PARTS} values" in answer.json()["error"]["message"]
