"""The service as it is run: uvicorn, two worker processes, real sockets, signals."""

import signal
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from api.http.app import create_app
from tests.api.client import Client
from tests.api.deployment import bearer, deploy, images, photo
from tests.api.server_process import Server
from tests.api.shapes import assert_error
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("server")
    deployment = deploy(folder, workers=2, port=free_port(), compute_slots=1, open_metrics=True)
    with Server(deployment, folder) as running:
        yield running


@pytest.fixture(scope="module")
def http(server: Server) -> Iterator[httpx.Client]:
    """A client of the service, in which subject ``a`` is enrolled."""
    with httpx.Client(
        base_url=server.url, headers=bearer(server.deployment.token), timeout=PATIENCE_S
    ) as client:
        assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).status_code == 201
        yield client


@pytest.mark.usefixtures("http")
def test_workers_share_the_database_and_nothing_else(server: Server) -> None:
    def verify(person: int) -> str:
        # A connection of its own each time, so that either worker answers.
        answer = httpx.post(
            f"{server.url}/v1/subjects/a/verify",
            files=images(photo(person, 3), name="image"),
            headers=bearer(server.deployment.token),
            timeout=PATIENCE_S,
        )
        return str(answer.json()["decision"])

    # Eight at once are answered in any order. Four strangers cannot lock the subject in any.
    people = [1, 1, 2, 1, 1, 1] * 4
    with ThreadPoolExecutor(8) as pool:
        decisions = list(pool.map(verify, people))
    assert decisions == ["accept" if person == 1 else "reject" for person in people]

    def started() -> set[int]:
        return {line["pid"] for line in server.lines() if line["event"] == "started"}

    wait_until(lambda: len(started()) == 2, what="both workers")


def test_a_client_that_asks_first_is_told_at_once(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        raw.settimeout(PATIENCE_S)
        raw.sendall(
            b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\n"
            b"Authorization: Bearer vf_x\r\nContent-Length: 100000000\r\n\r\n"
        )
        first = raw.recv(65536)
    assert first.startswith(b"HTTP/1.1 401")


@pytest.mark.usefixtures("http")
def test_stopping_finishes_what_runs_and_logs_only_json(server: Server) -> None:
    body = (
        b'--b\r\nContent-Disposition: form-data; name="image"; filename="f"\r\n\r\n'
        + photo(1, 5)
        + b"\r\n--b--\r\n"
    )
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        raw.settimeout(PATIENCE_S)
        raw.sendall(
            b"POST /v1/subjects/a/verify HTTP/1.1\r\nHost: x\r\n"
            + f"Authorization: Bearer {server.deployment.token}\r\n".encode()
            + b"Content-Type: multipart/form-data; boundary=b\r\n"
            + f"Content-Length: {len(body)}\r\n\r\n".encode()
            + body[:1000]
        )
        wait_until(lambda: server.in_flight() == 2, what="a worker that reads")  # and the scrape
        server.process.send_signal(signal.SIGTERM)

        def refused() -> bool:
            try:
                socket.create_connection(("127.0.0.1", server.port)).close()
            except ConnectionRefusedError:
                return True
            return False

        # What watches the service sees at once that it is not ready any more.
        wait_until(refused, what="a port that nobody listens on")
        raw.sendall(body[1000:])
        seen = b""
        while piece := raw.recv(65536):
            seen += piece
        assert b'"decision":"accept"' in seen
    assert server.stop() == 0
    lines = server.lines()
    assert "Traceback" not in server.log.read_text()
    assert sum(line["event"] == "stopped" for line in lines) == 2
    events = {line["event"] for line in lines}
    assert not any("HTTP/1.1" in event for event in events)
    assert not any(line.get("status", 0) >= 500 for line in lines)
    assert server.deployment.token not in server.log.read_text()


def test_a_worker_starts_while_the_database_is_away(tmp_path: Path) -> None:
    """It says so; one that could not start would stop the workers beside it."""
    deployment = deploy(tmp_path)
    nobody = f"postgresql+psycopg://veilface@127.0.0.1:{free_port()}/veilface"
    away = deployment.settings.model_copy(update={"database_url": nobody})
    with Client(create_app(away), headers=bearer(deployment.token)) as client:
        for path in ("/health/ready", "/v1/contract"):
            assert_error(client.get(path), 503, "store_unavailable")
        assert client.get("/health/live").status_code == 200
