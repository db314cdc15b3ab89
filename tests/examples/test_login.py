"""The login examples, as processes of their own, before a real service with the demo model."""

import re
import subprocess
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import quote

import httpx
import pytest

from tests.examples.conftest import EXAMPLES, PYTHON, Service, clean_environment, node, running
from tests.patience import PATIENCE_S
from tests.ports import free_port
from veilface_client import Client


@pytest.fixture(params=["login.mjs", "login.py"], scope="module")
def login(
    request: pytest.FixtureRequest, service: Service, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    program = node() if request.param.endswith(".mjs") else PYTHON
    port = free_port()
    env = clean_environment(
        VEILFACE_URL=service.url, VEILFACE_API_KEY=service.verifying, PORT=str(port)
    )
    log = tmp_path_factory.mktemp("login") / "login.log"
    arguments = [program, str(EXAMPLES / "login" / request.param)]
    with running(arguments, f"http://127.0.0.1:{port}/", env, log) as url:
        yield url


def show(login: str, name: str, *photos: bytes, **fields: str) -> httpx.Response:
    """Post photos as a browser's form does."""
    files = [("images", (f"{number}.jpg", photo)) for number, photo in enumerate(photos)]
    url = httpx.URL(login).copy_with(raw_path=f"/{quote(name, safe='%.')}".encode())
    return httpx.post(url, files=files, data=fields, timeout=PATIENCE_S)


def test_who_is_let_in(login: str, service: Service) -> None:
    own = service.photo(1, 3), service.photo(1, 4)
    # A form has no say in how it is judged: this level and this field do not exist.
    accepted = show(login, "ann", *own, level="laxest", anything="else")
    assert accepted.status_code == 204, accepted.text
    cookie = accepted.headers["Set-Cookie"]
    assert cookie.startswith("session=")
    assert cookie.endswith("; HttpOnly; Secure; SameSite=Strict")
    for name, photos in (("ann", [service.photo(2, 0), service.photo(2, 1)]), ("nobody", own)):
        rejected = show(login, name, *photos)
        assert (rejected.status_code, rejected.text) == (401, "not recognised, try again")
        assert "Set-Cookie" not in rejected.headers
    with Client(service.url, service.token) as client:
        client.reset_lockout("ann")


@pytest.mark.parametrize(
    ("name", "photo", "statuses"),
    [
        ("ann", b"no picture", {400}),
        *(
            (name, b"no picture", {400, 422, 502})
            for name in ("..", "%2e%2e", "%2e%2e%2fann", "ann%3f", "%ff")
        ),
    ],
)
def test_what_is_no_attempt_opens_nothing(
    login: str, name: str, photo: bytes, statuses: set[int]
) -> None:
    answers = [
        show(login, name, photo),
        show(login, name),
        httpx.post(f"{login}ann", content=b"no form", timeout=PATIENCE_S),
    ]
    assert answers[0].status_code in statuses
    assert {answer.status_code for answer in answers[1:]} == {400}
    assert not any("Set-Cookie" in answer.headers for answer in answers)


def test_the_readme_logs_in_by_the_example(service: Service, tmp_path: Path) -> None:
    node()
    root = EXAMPLES.parent
    text = (root / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```sh\n(veilface keys create .*?)^```", text, flags=re.M | re.S)
    port = free_port()
    for theirs, here in (
        ("http://127.0.0.1:8421", service.url),
        ("http://127.0.0.1:3000", f"http://127.0.0.1:{port}"),
    ):
        assert theirs in block
        block = block.replace(theirs, here)
    (tmp_path / "examples").symlink_to(EXAMPLES)
    for number in (4, 5):
        (tmp_path / f"anna{number}.jpg").write_bytes(service.photo(1, number - 1))
    made = "veilface keys create --right verify --label login --out veilface-data-keys/login-key\n"
    assert made in block  # the deployment of the service is elsewhere
    block = block.replace(
        made, f"mkdir veilface-data-keys; echo {service.verifying} > veilface-data-keys/login-key\n"
    )
    with Client(service.url, service.token) as client:
        client.enroll("anna", [service.photo(1, number) for number in range(3)])
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", f"trap 'kill $(jobs -p)' EXIT\n{block}"],
            cwd=tmp_path,
            env=clean_environment(PORT=str(port)),
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        client.erase("anna")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("HTTP/1.1 204")
    assert "\nSet-Cookie: session=" in done.stdout


def test_the_page_enrolls_whom_the_readme_logs_in(service: Service, tmp_path: Path) -> None:
    text = (EXAMPLES.parent / "docs" / "login.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```js\n(.*?)^```", text, flags=re.M | re.S)
    (tmp_path / "enroll.mjs").write_text(block, encoding="utf-8")
    for number in range(3):
        (tmp_path / f"anna{number + 1}.jpg").write_bytes(service.photo(1, number))
    env = clean_environment(VEILFACE_URL=service.url, VEILFACE_API_KEY=service.token)
    with Client(service.url, service.token) as client:
        told = [
            subprocess.run(
                [node(), "enroll.mjs"],
                cwd=tmp_path,
                env=env,
                capture_output=True,
                text=True,
                timeout=PATIENCE_S,
                check=True,
            ).stdout
            for _ in range(2)
        ]
        assert client.verify("anna", service.photo(1, 4))
        client.erase("anna")
    assert told[0] == "201 enrolled\n"
    assert told[1].startswith("409 ")


class Impostor(BaseHTTPRequestHandler):
    """Sends a request on to where everybody is accepted, or leaves it without an answer."""

    redirects: bool

    def do_POST(self) -> None:
        self.rfile.read(int(self.headers["Content-Length"]))
        if not self.redirects:
            self.close_connection = False
            return
        accepts = self.path == "/accept"
        self.send_response(200 if accepts else 307)
        self.send_header("Location", "/accept")
        self.send_header("Content-Length", "21" if accepts else "0")
        self.end_headers()
        self.wfile.write(b'{"decision":"accept"}' if accepts else b"")


@pytest.mark.parametrize("redirects", [True, False])
def test_another_answer_than_the_services_opens_nothing(tmp_path: Path, redirects: bool) -> None:
    handler = type("Handler", (Impostor,), {"redirects": redirects})
    port = free_port()
    hurry = "const real = AbortSignal.timeout; AbortSignal.timeout = () => real(100)"
    env = clean_environment(
        VEILFACE_API_KEY="vf_key",
        PORT=str(port),
        NODE_OPTIONS="" if redirects else f"--import=data:text/javascript,{quote(hurry)}",
    )
    arguments = [node(), str(EXAMPLES / "login" / "login.mjs")]
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        env["VEILFACE_URL"] = f"http://127.0.0.1:{server.server_address[1]}"
        with running(arguments, f"http://127.0.0.1:{port}/", env, tmp_path / "log") as url:
            answer = show(url, "ann", b"x")
        server.shutdown()
    assert (answer.status_code, answer.text) == (502, "use your password")
