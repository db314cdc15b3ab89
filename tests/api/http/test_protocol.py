"""What is refused of a request on its connection, by a real server and raw sockets."""

import contextlib
import json
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import h11
import httpx
import pytest

from api.http.app import uvicorn_options
from api.http.protocol import (
    CHUNKS,
    MAX_HEAD_BYTES,
    MAX_HEADERS,
    MEAN_CHUNK_BYTES,
    BoundedConnection,
    Protocol,
)
from tests.api.deployment import bearer, deploy, images, photo
from tests.api.service.test_server import Server
from tests.ports import free_port

PATIENCE_S = 60
"""Of a socket, so that a server that says nothing fails a test instead of stopping it."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("server")
    deployment = deploy(folder, workers=1, port=free_port())
    assert uvicorn_options(deployment.settings, deployment.contract)["http"] is Protocol
    running = Server(deployment, folder)
    try:
        running.wait()
        yield running
    finally:
        running.process.kill()
        running.process.wait()


@pytest.fixture(autouse=True)
def unharmed(server: Server) -> Iterator[None]:
    """Nothing ends in a traceback, and what is not JSON is not logged."""
    yield
    assert httpx.get(f"{server.url}/health/live", timeout=PATIENCE_S).status_code == 200
    events = [json.loads(line)["event"] for line in server.log.read_text().splitlines()]
    assert not any("xception" in event or "Fatal" in event for event in events), events


def connect(server: Server) -> socket.socket:
    raw = socket.create_connection(("127.0.0.1", server.deployment.settings.port))
    raw.settimeout(PATIENCE_S)
    return raw


def until_closed(raw: socket.socket) -> bytes:
    """All that the server sends before it closes the connection."""
    seen = b""
    with contextlib.suppress(ConnectionResetError):
        while piece := raw.recv(65536):
            seen += piece
    return seen


def sends_until_closed(raw: socket.socket, piece: bytes) -> bytes:
    """What the server sends while it is sent the same for as long as it keeps the connection."""
    seen = b""
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        for _ in range(10**5):
            raw.sendall(piece)
            with contextlib.suppress(BlockingIOError):
                answer = raw.recv(65536, socket.MSG_DONTWAIT)
                if not answer:
                    return seen
                seen += answer
        pytest.fail("the server takes it for ever")
    return seen + until_closed(raw)


def error_of(seen: bytes) -> str:
    """The message of the one answer there is: a refusal in the one shape, which ends all."""
    head, _, body = seen.partition(b"\r\n\r\n")
    status, *headers = head.decode().lower().split("\r\n")
    assert status == "http/1.1 400 bad request"
    assert {"connection: close", "content-type: application/json"} <= set(headers)
    assert any(line.startswith("x-request-id: ") for line in headers)
    answer = json.loads(body)  # and nothing behind it
    assert set(answer) == {"error", "request_id"}
    assert answer["error"]["code"] == "malformed_request"
    assert answer["error"]["details"] == {}
    return str(answer["error"]["message"])


HOST = b"Host: x\r\n"
SMUGGLED = b"GET /health/live HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.mark.parametrize(
    ("request_bytes", "said"),
    [
        (
            b"POST /v1/contract HTTP/1.1\r\nHost: x\r\nContent-Length: 4\r\n"
            b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
            "both Content-Length and Transfer-Encoding",
        ),
        (
            b"POST /v1/contract HTTP/1.1\r\nHost: x\r\ntransfer-encoding: CHUNKED\r\n"
            b"content-length: 0\r\n\r\n" + SMUGGLED,
            "both Content-Length and Transfer-Encoding",
        ),
        (
            b"POST /v1/contract HTTP/1.0\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
            "HTTP/1.0 has no Transfer-Encoding",
        ),
        (
            b"POST /v1/contract HTTP/1.1\r\nHost: x\r\nContent-Length: 0\r\n"
            b"Content-Length: 40\r\n\r\n" + SMUGGLED,
            "not a well-formed HTTP/1.1 request",
        ),
        (
            b"POST /v1/contract HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: gzip, chunked\r\n\r\n"
            + SMUGGLED,
            "not a well-formed HTTP/1.1 request",
        ),
        (b"GET / HTTP/1.1\r\n\r\n", "not a well-formed HTTP/1.1 request"),  # no Host
        (b"\x16\x03\x01\x02\x00\x01", "not a well-formed HTTP/1.1 request"),  # TLS on a plain port
        (b"GET /v1/contract HTTP/1.1\r\nHost: x\r\nX-Long: " + b"a" * 70_000 + b"\r\n\r\n",
         f"more than {MAX_HEAD_BYTES} bytes"),
        (b"GET /v1/contract?" + b"a" * 70_000 + b" HTTP/1.1\r\nHost: x\r\n\r\n",
         f"more than {MAX_HEAD_BYTES} bytes"),
        (b"GET /v1/contract HTTP/1.1\r\n" + HOST + b"a:\n" * MAX_HEADERS + b"\n",
         f"more than {MAX_HEADERS} headers"),
        (b"GET /v1/contract HTTP/1.1\r\n" + HOST + b"a:\n" * 70_000 + b"\n", "more than 1"),
    ],
)  # fmt: skip
def test_a_request_that_can_be_misread_is_refused_and_ends_the_connection(
    server: Server, request_bytes: bytes, said: str
) -> None:
    with connect(server) as raw:
        raw.sendall(request_bytes)
        assert said in error_of(until_closed(raw))


def test_a_large_head_that_fits_is_answered(server: Server) -> None:
    rest = MAX_HEAD_BYTES - len(b"GET /health/live HTTP/1.1\r\nHost: x\r\nX: \r\n\r\n")
    for size, status in ((rest, 200), (rest + 1, 400)):
        with connect(server) as raw:
            raw.sendall(b"GET /health/live HTTP/1.1\r\nHost: x\r\nX: " + b"a" * size + b"\r\n\r\n")
            assert raw.recv(65536).startswith(f"HTTP/1.1 {status} ".encode())
    few = b"".join(b"X-%d: y\r\n" % number for number in range(MAX_HEADERS - 1))
    with connect(server) as raw:
        raw.sendall(b"GET /health/live HTTP/1.1\r\n" + HOST + few + b"\r\n")
        assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_requests_in_a_row_and_in_one_piece_are_answered(server: Server) -> None:
    with connect(server) as raw:
        for _ in range(3):
            raw.sendall(SMUGGLED * 2)
            seen = b""
            while seen.count(b'"status"') < 2:
                seen += raw.recv(65536)
            assert seen.count(b"HTTP/1.1 200 ") == 2


def chunks_taken(sizes: Iterator[int]) -> int:
    """Chunks of a body that a connection takes before it refuses the next."""
    connection = BoundedConnection()
    connection.receive_data(b"PUT / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
    assert isinstance(connection.next_event(), h11.Request)
    for taken, size in enumerate(sizes):
        connection.receive_data(b"%x\r\n" % size + b"x" * size + b"\r\n")
        try:
            event = connection.next_event()
        except h11.RemoteProtocolError:
            assert connection.refusal is not None
            assert "larger chunks" in connection.refusal.message
            return taken
        assert isinstance(event, h11.Data)
        assert len(event.data) == size
    return taken + 1


def test_small_chunks_are_taken_up_to_a_number() -> None:
    assert chunks_taken(iter([1] * 1000)) == CHUNKS
    assert chunks_taken(iter([MEAN_CHUNK_BYTES] * 2000)) == 2000
    # One that is large is paid for once.
    large = 10 * MEAN_CHUNK_BYTES
    assert chunks_taken(iter([large] + [1] * 1000)) == CHUNKS + 10
    # The count begins anew with each request.
    connection = BoundedConnection()
    body = b"1\r\nx\r\n" * CHUNKS + b"0\r\n\r\n"
    for _ in range(3):
        connection.receive_data(
            b"PUT / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n" + body
        )
        while not isinstance(connection.next_event(), h11.EndOfMessage):
            pass
        connection.send(h11.Response(status_code=200, headers=[("Content-Length", "0")]))
        connection.send(h11.EndOfMessage())
        connection.start_next_cycle()


@pytest.mark.parametrize("authorized", [False, True])
def test_bodies_in_tiny_chunks_end_their_connections(server: Server, authorized: bool) -> None:
    token = server.deployment.token if authorized else "none"
    head = (
        b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n"
        b"Content-Type: application/json\r\n" + f"Authorization: Bearer {token}\r\n\r\n".encode()
    )

    def flood(_: int) -> bytes:
        with connect(server) as raw:
            raw.sendall(head)
            return sends_until_closed(raw, b"1\r\n{\r\n" * 1000)

    with ThreadPoolExecutor(8) as pool:
        floods = [pool.submit(flood, number) for number in range(16)]
        while not all(each.done() for each in floods):
            assert httpx.get(f"{server.url}/health/live", timeout=PATIENCE_S).status_code == 200
        answers = [each.result() for each in floods]
    for answer in answers:
        if answer.startswith(b"HTTP/1.1 401"):
            assert not authorized  # its own refusal came first
        else:
            assert "larger chunks" in error_of(answer)


def test_a_body_in_ordinary_chunks_is_taken(server: Server) -> None:
    photos = [photo(1, shot) + bytes(10_000) for shot in range(9)]
    request = httpx.Request("PUT", server.url, files=images(*photos))
    body = request.read()
    pieces = [body[start : start + 600] for start in range(0, len(body), 600)]
    assert len(pieces) > CHUNKS
    answer = httpx.put(
        f"{server.url}/v1/subjects/chunked/enrollment",
        content=iter(pieces),
        headers={
            **bearer(server.deployment.token),
            "Content-Type": request.headers["Content-Type"],
        },
        timeout=PATIENCE_S,
    )
    assert answer.status_code == 201


@pytest.mark.parametrize("broken", [b"zz\r\n", b"1\r\nxy\r\n", b"0\r\n" + b"a:\n" * 70_000 + b"\n"])
def test_a_body_that_breaks_off_ends_in_one_answer(server: Server, broken: bytes) -> None:
    with connect(server) as raw:
        raw.sendall(
            b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n"
            b"Content-Type: application/json\r\n"
            + f"Authorization: Bearer {server.deployment.token}\r\n\r\n".encode()
            + b"4\r\n{   \r\n"
        )
        raw.sendall(broken)
        assert "not a well-formed HTTP/1.1 request" in error_of(until_closed(raw))


def test_a_body_that_nobody_reads_ends_its_connection(server: Server) -> None:
    with connect(server) as raw:
        # It waits to be asked for its body, is answered without, and sends it all the same.
        raw.sendall(
            b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n"
            b"Authorization: Bearer vf_x\r\nContent-Length: 1000000000\r\n\r\n"
        )
        answer = raw.recv(65536)
        assert answer.startswith(b"HTTP/1.1 401 ")
        assert b"HTTP/1.1" not in sends_until_closed(raw, b"x" * 1000)
