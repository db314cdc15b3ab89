"""The service as it is run: uvicorn, two worker processes, real sockets, signals."""

import contextlib
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from tests.api.deployment import Deployment, bearer, deploy, environment_of, images, photo
from tests.api.shapes import assert_error
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port

RUN = """
from api.service.opening import open_contract, open_keyring
from api.service.supervisor import run_server
from api.settings import load_settings

settings = load_settings()
run_server(settings, open_contract(settings, open_keyring(settings)))
"""


def in_flight(url: str) -> float:
    """How many requests the workers of a service are answering."""
    text = httpx.get(f"{url}/metrics", timeout=PATIENCE_S).text
    return float(re.findall(r"^veilface_requests_in_flight (.+)$", text, flags=re.M)[0])


class Server:
    def __init__(self, deployment: Deployment, folder: Path, **environment: str) -> None:
        self.deployment = deployment
        self.log = folder / "stderr"
        self.url = f"http://127.0.0.1:{deployment.settings.port}"
        with self.log.open("wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-c", RUN],
                cwd=Path(__file__).resolve().parents[3],
                env={**environment_of(deployment.settings), "OMP_NUM_THREADS": "1", **environment},
                stderr=stderr,
            )

    def wait(self) -> None:
        def ready() -> bool:
            assert self.process.poll() is None, self.log.read_text()
            with contextlib.suppress(httpx.TransportError):
                answer = httpx.get(f"{self.url}/health/ready", timeout=PATIENCE_S)
                return answer.status_code == 200
            return False

        wait_until(ready, what="a server that is ready")

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("server")
    running = Server(deploy(folder, workers=2, port=free_port(), compute_slots=1), folder)
    try:
        running.wait()
        yield running
    finally:
        if running.process.poll() is None:
            running.process.kill()
            running.process.wait()


@pytest.fixture(scope="module")
def http(server: Server) -> Iterator[httpx.Client]:
    """A client of the service, in which subject ``a`` is enrolled."""
    with httpx.Client(
        base_url=server.url, headers=bearer(server.deployment.token), timeout=PATIENCE_S
    ) as client:
        assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).status_code == 201
        yield client


@pytest.mark.long
@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_a_start_that_is_stopped_leaves_nothing(tmp_path: Path, seconds: float) -> None:
    deployment = deploy(tmp_path, workers=2, port=free_port(), compute_slots=1)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    process = subprocess.Popen(
        [sys.executable, "-m", "veilface", "serve"],
        cwd=Path(__file__).resolve().parents[3],
        env={**environment_of(deployment.settings), "TMPDIR": str(temporary)},
        stderr=subprocess.DEVNULL,
    )
    wait_until(lambda: any(temporary.iterdir()), what="the folder that workers count in")
    time.sleep(seconds)
    process.terminate()
    assert process.wait(timeout=PATIENCE_S) == 0
    assert list(temporary.iterdir()) == []


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
        # A worker may be ready long before the other, and in the middle of a line.
        whole = [line for line in server.log.read_text().splitlines(True) if line.endswith("\n")]
        lines = [json.loads(line) for line in whole]
        return {line["pid"] for line in lines if line["event"] == "started"}

    wait_until(lambda: len(started()) == 2, what="both workers")


def test_a_large_body_gets_its_answer(server: Server, http: httpx.Client) -> None:
    limits = server.deployment.settings
    image = photo(1) + b"\x00" * limits.max_image_bytes
    answer = http.put("/v1/subjects/a/enrollment", files=images(image))
    assert_error(answer, 413, "image_too_large")
    answer = http.put("/v1/subjects/a/enrollment", files=images(*[image[:-100_000]] * 5))
    assert_error(answer, 413, "request_too_large")

    def chunks() -> Iterator[bytes]:
        for _ in range(64):
            yield b"x" * 1024 * 1024

    answer = http.put(
        "/v1/subjects/a/enrollment",
        content=chunks(),
        headers={"Content-Type": "application/json"},
    )
    assert_error(answer, 413, "request_too_large")
    assert http.get("/health/live").status_code == 200


def test_a_client_that_goes_away_does_no_harm(server: Server, http: httpx.Client) -> None:
    for _ in range(5):
        with socket.create_connection(("127.0.0.1", server.deployment.settings.port)) as raw:
            raw.sendall(
                b"PUT /v1/subjects/a/enrollment HTTP/1.1\r\nHost: x\r\n"
                + f"Authorization: Bearer {server.deployment.token}\r\n".encode()
                + b"Content-Type: multipart/form-data; boundary=b\r\nContent-Length: 100000\r\n\r\n"
                + b'--b\r\nContent-Disposition: form-data; name="images"; filename="f"\r\n\r\nabc'
            )
    assert http.get("/health/ready").status_code == 200
    assert http.get("/v1/subjects/a").status_code == 200


def test_headers_without_end_are_refused(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.deployment.settings.port)) as raw:
        raw.settimeout(PATIENCE_S)
        raw.sendall(b"GET /v1/contract HTTP/1.1\r\nHost: x\r\nX-Long: ")
        seen = b""
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            for _ in range(64):
                raw.sendall(b"a" * 4096)
            seen = raw.recv(65536)
        assert seen.startswith(b"HTTP/1.1 400") or not seen
    assert httpx.get(f"{server.url}/health/ready", timeout=PATIENCE_S).status_code == 200


def test_a_client_that_asks_first_is_told_at_once(server: Server) -> None:
    with socket.create_connection(("127.0.0.1", server.deployment.settings.port)) as raw:
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
    with socket.create_connection(("127.0.0.1", server.deployment.settings.port)) as raw:
        raw.settimeout(PATIENCE_S)
        raw.sendall(
            b"POST /v1/subjects/a/verify HTTP/1.1\r\nHost: x\r\n"
            + f"Authorization: Bearer {server.deployment.token}\r\n".encode()
            + b"Content-Type: multipart/form-data; boundary=b\r\n"
            + f"Content-Length: {len(body)}\r\n\r\n".encode()
            + body[:1000]
        )
        wait_until(lambda: in_flight(server.url) == 1, what="a worker that reads")
        server.process.send_signal(signal.SIGTERM)
        time.sleep(1)
        raw.sendall(body[1000:])
        seen = b""
        while piece := raw.recv(65536):
            seen += piece
        assert b'"decision":"accept"' in seen
    assert server.stop() == 0
    lines = [json.loads(line) for line in server.log.read_text().splitlines()]
    assert sum(line["event"] == "stopped" for line in lines) == 2
    events = {line["event"] for line in lines}
    assert not any("HTTP/1.1" in event for event in events)
    assert not any(line.get("status", 0) >= 500 for line in lines)
    assert server.deployment.token not in server.log.read_text()
