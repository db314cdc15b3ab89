"""Abuse of a connection, by raw sockets: it ends soon, and keeps nobody else from an answer."""

import contextlib
import json
import select
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from api.http.protocol import MAX_FRAMING_BYTES
from tests.api.deployment import bearer, deploy, images, photo
from tests.api.server_process import Server
from tests.ports import free_port

PATIENCE_S = 60
"""Of a socket, so that a server that says nothing fails a test instead of stopping it."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("server")
    with Server(deploy(folder, port=free_port()), folder) as running:
        yield running


@pytest.fixture(autouse=True)
def unharmed(server: Server) -> Iterator[None]:
    """Nothing ends in a traceback, and what is not JSON is not logged."""
    yield
    assert server.get("/health/live").status_code == 200
    assert "Traceback" not in server.log.read_text()


def connect(server: Server) -> socket.socket:
    raw = socket.create_connection(("127.0.0.1", server.port))
    raw.settimeout(PATIENCE_S)
    return raw


def exchange(raw: socket.socket, *pieces: bytes) -> bytes:
    """What the server sends, in answer to pieces, until it closes or resets the connection."""
    seen = b""
    with contextlib.suppress(BrokenPipeError, ConnectionResetError):
        for piece in pieces:
            raw.sendall(piece)
            if select.select([raw], [], [], 0)[0]:
                answer = raw.recv(65536)
                if not answer:
                    return seen
                seen += answer
        while answer := raw.recv(65536):
            seen += answer
    return seen


def assert_refused(seen: bytes) -> None:
    """One answer in the one shape; or none, where the server did not wait for the rest."""
    if not seen:
        return
    head, _, body = seen.partition(b"\r\n\r\n")
    status, *headers = head.decode().lower().split("\r\n")
    assert status == "http/1.1 400 bad request"
    assert {"connection: close", "content-type: application/json"} <= set(headers)
    answer = json.loads(body)  # and nothing behind it
    assert f"x-request-id: {answer['request_id']}" in headers
    assert answer["error"]["code"] == "malformed_request"


SMUGGLED = b"GET /health/live HTTP/1.1\r\nHost: x\r\n\r\n"
POST = b"POST /v1/contract HTTP/1.1\r\nHost: x\r\n"


@pytest.mark.parametrize(
    "request_bytes",
    [
        POST + b"Content-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"transfer-encoding: CHUNKED\r\ncontent-length: 0\r\n\r\n" + SMUGGLED,
        POST + b"Content-Length: 0\r\nContent-Length: 40\r\n\r\n" + SMUGGLED,
        POST + b"Content-Length: +4\r\n\r\nabcd" + SMUGGLED,
        POST + b"Transfer-Encoding: chunked, gzip\r\n\r\n0\r\n\r\n" + SMUGGLED,
        POST + b"Transfer-Encoding : chunked\r\n\r\n0\r\n\r\n" + SMUGGLED,
        b"GET /health/live HTTP/1.1\r\nHost: x\r\nA: b\r\n c: d\r\n\r\n" + SMUGGLED,
        b"\x16\x03\x01\x02\x00\x01",  # TLS on a plain port
    ],
)
def test_a_request_that_can_be_misread_is_refused_and_ends_the_connection(
    server: Server, request_bytes: bytes
) -> None:
    with connect(server) as raw:
        seen = exchange(raw, request_bytes)
    assert seen
    assert_refused(seen)


def test_a_head_within_the_bound_is_answered(server: Server) -> None:
    size = MAX_FRAMING_BYTES - len(b"GET /health/live HTTP/1.1\r\nHost: x\r\nX: \r\n\r\n")
    with connect(server) as raw:
        raw.sendall(b"GET /health/live HTTP/1.1\r\nHost: x\r\nX: " + b"a" * size + b"\r\n\r\n")
        assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_requests_in_a_row_and_in_one_piece_are_answered(server: Server) -> None:
    with connect(server) as raw:
        for _ in range(3):
            raw.sendall(SMUGGLED * 2)
            seen = b""
            while seen.count(b'"status"') < 2:
                seen += raw.recv(65536)
            assert seen.count(b"HTTP/1.1 200 ") == 2


def test_what_follows_a_refused_body_is_bounded(server: Server) -> None:
    """The rest of the body is dropped, and earns no room for trailers."""
    head = POST + b"Transfer-Encoding: chunked\r\n\r\n"
    body = (b"10000\r\n" + b"x" * 0x10000 + b"\r\n") * 100
    with connect(server) as raw:
        seen = exchange(raw, head, body, b"0\r\n", *[b"a: b\r\n" * 1_000] * 100)
    assert seen.startswith(b"HTTP/1.1 405 ")


def test_a_flood_of_requests_on_one_connection_ends_it(server: Server) -> None:
    with connect(server) as raw:
        seen = exchange(raw, SMUGGLED * 4_000)
    assert seen.count(b"HTTP/1.1 200 ") < 4_000


PUT = b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"


@pytest.mark.parametrize("authorized", [False, True])
@pytest.mark.parametrize(
    ("head", "piece"),
    [
        (b"GET /v1/contract HTTP/1.1\r\nHost: x\r\nX-Long: ", b"a"),
        (b"GET /v1/contract?", b"a"),
        (b"GET /v1/contract HTTP/1.1\r\nHost: x\r\n", b"a: b\r\n"),
        (PUT + b"Transfer-Encoding: chunked\r\n%b\r\n", b"1\r\n{\r\n"),
        (PUT + b"Transfer-Encoding: chunked\r\n%b\r\n1;a=", b"a"),
        (PUT + b"Transfer-Encoding: chunked\r\n%b\r\n2\r\n{}\r\n0\r\n", b"a: b\r\n"),
    ],
)
def test_framing_without_end_ends_the_connection(
    server: Server, head: bytes, piece: bytes, authorized: bool
) -> None:
    """Several at a time, while another client is answered."""
    key = f"Authorization: Bearer {server.deployment.token if authorized else 'none'}\r\n".encode()

    def flood(_: int) -> bytes:
        with connect(server) as raw:
            return exchange(raw, head.replace(b"%b", key), *[piece * 10_000] * 100)

    with ThreadPoolExecutor(8) as pool:
        floods = [pool.submit(flood, number) for number in range(8)]
        while not all(each.done() for each in floods):
            assert server.get("/health/live").status_code == 200
    for each in floods:
        seen = each.result()
        if not seen.startswith(b"HTTP/1.1 401"):  # its own refusal may come first
            assert_refused(seen)


def test_a_body_in_ordinary_chunks_is_taken(server: Server) -> None:
    photos = [photo(1, shot) + bytes(10_000) for shot in range(9)]
    request = httpx.Request("PUT", server.url, files=images(*photos))
    body = request.read()
    answer = httpx.put(
        f"{server.url}/v1/subjects/chunked/enrollment",
        content=(body[start : start + 80] for start in range(0, len(body), 80)),
        headers={
            **bearer(server.deployment.token),
            "Content-Type": request.headers["Content-Type"],
        },
        timeout=PATIENCE_S,
    )
    assert answer.status_code == 201


@pytest.mark.parametrize("broken", [b"zz\r\n", b"1\r\nxy\r\n"])
def test_a_body_that_breaks_off_ends_in_one_answer(server: Server, broken: bytes) -> None:
    key = f"Authorization: Bearer {server.deployment.token}\r\n".encode()
    with connect(server) as raw:
        seen = exchange(
            raw, PUT + b"Transfer-Encoding: chunked\r\n" + key + b"\r\n4\r\n{   \r\n", broken
        )
    assert_refused(seen)


def test_slow_bodies_keep_no_other_key_waiting(server: Server) -> None:
    """More of them than there are places for one key."""
    key = f"Authorization: Bearer {server.deployment.token}\r\n".encode()
    other = server.deployment.key("enroll", tenant="other")
    with contextlib.ExitStack() as held:
        for _ in range(60):
            raw = held.enter_context(connect(server))
            raw.sendall(PUT + key + b"Content-Length: 1000\r\n\r\n{")
        answer = httpx.put(
            f"{server.url}/v1/subjects/b/enrollment",
            files=images(photo(1)),
            headers=bearer(other),
            timeout=PATIENCE_S,
        )
        assert answer.status_code == 201
