"""Delivery of events: to a real receiver, over failures, and after the service was killed."""

import base64
import json
import os
import re
import secrets
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import anyio
import httpx
import pytest
from anyio.from_thread import start_blocking_portal

from api.http.app import create_app
from api.http.errors import StartError
from api.process.runtime import open_keyring, open_store
from api.process.webhooks import LONGEST_S, deliver, send
from api.settings import load_settings
from templates.errors import SealError
from templates.keys.sealing import MasterKeyring
from templates.keys.webhook_secret import read_webhook_secrets, signatures
from templates.store import TemplateStore
from templates.store.outbox import LEASE, Event, Outbox
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, environment_of, images, photo
from tests.clients.conftest import VEILFACE
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from tests.templates.store.conftest import put

SECRET = b"0123456789abcdef0123456789abcdef"
LINE = "whsec_" + base64.b64encode(SECRET).decode()
PAGE = Path(__file__).resolve().parents[3] / "docs" / "webhooks.md"


class Endpoint(ThreadingHTTPServer):
    """Keeps what it was sent; refuses as many as it is told, or what another secret signed."""

    def __init__(self, port: int = 0, *, refuse: int = 0, secret: bytes | None = None) -> None:
        self.received: list[tuple[dict[str, str], bytes]] = []
        self.refuse = refuse
        self.secret = secret
        super().__init__(("127.0.0.1", port), _Handler)

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/events"

    def events(self) -> list[dict]:
        return [json.loads(body) for _, body in self.received]


class _Handler(BaseHTTPRequestHandler):
    server: Endpoint

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.server.received.append(({k.lower(): v for k, v in self.headers.items()}, body))
        refused = len(self.server.received) <= self.server.refuse
        if (secret := self.server.secret) is not None:
            named, at = self.headers["webhook-id"], int(self.headers["webhook-timestamp"])
            expected = signatures([secret], named, at, body.decode())
            refused = self.headers["webhook-signature"] != expected
        self.send_response(302 if refused else 204)
        if refused:
            self.send_header("Location", "/elsewhere")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def listening(endpoint: Endpoint) -> Iterator[Endpoint]:
    thread = threading.Thread(target=endpoint.serve_forever)
    thread.start()
    try:
        yield endpoint
    finally:
        endpoint.shutdown()
        thread.join()
        endpoint.server_close()


def secret_file(folder: Path) -> Path:
    path = folder / "webhook-secret"
    path.write_text(LINE + "\n")
    path.chmod(0o600)
    return path


def telling(folder: Path, url: str, **changes: object) -> Deployment:
    return deploy(folder, webhook_url=url, webhook_secret_file=secret_file(folder), **changes)


def test_an_enrollment_is_told_once_it_is_taken(tmp_path: Path) -> None:
    with listening(Endpoint(refuse=1)) as endpoint:
        deployment = telling(tmp_path, endpoint.url)
        with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
            path = "/v1/subjects/ann/enrollment"
            enrolled = client.put(path, files=images(photo(1))).json()
            outbox = client.app.state.runtime.store.outbox
            wait_until(lambda: len(endpoint.received) == 2 and outbox.waiting() == 0)
    (first, body), (again, same) = endpoint.received
    # A redirect is a refusal: it went nowhere else, and the same event came again.
    assert body == same
    assert first["webhook-id"] == again["webhook-id"]
    data = {"tenant": "default", "subject_id": "ann", "template_id": enrolled["template_id"],
            "replaced": False}  # fmt: skip
    told = json.loads(body)
    assert (told["type"], told["data"]) == ("subject.enrolled", data)
    assert set(told) == {"type", "timestamp", "data"}
    for headers in (first, again):
        at = int(headers["webhook-timestamp"])
        assert headers["webhook-signature"] == signatures(
            [SECRET], headers["webhook-id"], at, body.decode()
        )


@contextmanager
def delivering(outbox: Outbox, url: str, secret: bytes = SECRET) -> Iterator[None]:
    """A worker's delivery, for the block."""
    with start_blocking_portal() as portal:
        future = portal.start_task_soon(partial(deliver, outbox, url, [secret]))
        try:
            yield
            assert not future.done(), "it goes on whatever happened"
        finally:
            future.cancel()


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TemplateStore]:
    """A store with the event of an enrollment, which is sent again at once."""
    monkeypatch.setattr("templates.store.outbox.FIRST_WAIT", timedelta(milliseconds=50))
    store = TemplateStore(
        f"sqlite:///{tmp_path / 'store.db'}", MasterKeyring([secrets.token_bytes(32)]),
        tells_events=True, timeout=PATIENCE_S,
    )  # fmt: skip
    store.upgrade()
    store.tenants.create("default")
    put(store, "ann", b"1")
    yield store
    store.close()


def test_a_worker_with_the_old_secret_loses_no_event(store: TemplateStore, tmp_path: Path) -> None:
    path = secret_file(tmp_path)
    (old,) = read_webhook_secrets(path)
    path.write_text("whsec_" + base64.b64encode(b"n" * 32).decode())
    (new,) = read_webhook_secrets(path)
    with listening(Endpoint(secret=new)) as endpoint:
        with delivering(store.outbox, endpoint.url, old):
            wait_until(lambda: len(endpoint.received) >= 2)
        assert store.outbox.waiting() == 1
        with delivering(store.outbox, endpoint.url, new):
            wait_until(lambda: store.outbox.waiting() == 0)
    assert {event["data"]["subject_id"] for event in endpoint.events()} == {"ann"}


def test_a_failure_of_any_kind_does_not_end_the_delivery(
    store: TemplateStore, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("api.process.webhooks.PAUSE_S", 0.01)
    failing, claim = (
        iter([TypeError("ann"), ValueError("ann"), OverflowError()]),
        store.outbox.claim,
    )

    def claim_or_fail() -> Event | None:
        for error in failing:
            raise error
        return claim()

    monkeypatch.setattr(store.outbox, "claim", claim_or_fail)
    caplog.set_level("WARNING")
    with listening(Endpoint()) as endpoint, delivering(store.outbox, endpoint.url):
        wait_until(lambda: store.outbox.waiting() == 0)
    assert len(endpoint.received) == 1
    assert caplog.text.count("webhook failed") == 3
    assert "ann" not in caplog.text


@pytest.mark.parametrize("url", ["https://a..b/x", "https://h:abc/", "https://999.1.1.1/"])
def test_what_cannot_be_sent_to_has_not_taken_it(url: str) -> None:
    assert not sent(url, [SECRET], Event("e", "{}", 1, datetime.now(UTC)))


def test_an_endpoint_that_trickles_is_left_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert timedelta(seconds=LONGEST_S) < LEASE
    monkeypatch.setattr("api.process.webhooks.LONGEST_S", 0.3)
    listener, ended = socket.create_server(("127.0.0.1", 0)), threading.Event()

    def trickle() -> None:
        connection, _ = listener.accept()
        with connection:
            connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
            # Each byte comes in time; a limit on one read alone would wait as long as this goes on.
            while not ended.wait(0.02):
                with suppress(OSError):
                    connection.sendall(b"x")

    thread = threading.Thread(target=trickle)
    thread.start()
    try:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}/"
        assert not sent(url, [SECRET], Event("e", "{}", 1, datetime.now(UTC)))
    finally:
        ended.set()
        thread.join()
        listener.close()


@pytest.mark.long
def test_nothing_is_lost_when_the_service_is_killed(tmp_path: Path) -> None:
    port, at = free_port(), free_port()
    deployment = telling(tmp_path, f"http://127.0.0.1:{port}/events", workers=2, port=at)
    ours = {name: value for name, value in os.environ.items() if not name.startswith("VEILFACE_")}
    env = ours | environment_of(deployment.settings) | {"OMP_NUM_THREADS": "1"}

    def start() -> "subprocess.Popen[bytes]":
        with (tmp_path / "serve.log").open("ab") as log:
            process = subprocess.Popen(
                [str(VEILFACE), "serve"], env=env, stdout=log, stderr=log, start_new_session=True
            )
        wait_until(lambda: process.poll() is not None or ready())
        return process

    def ready() -> bool:
        try:
            return httpx.get(f"http://127.0.0.1:{at}/health/ready", timeout=5).is_success
        except httpx.TransportError:
            return False

    process = start()
    for number in range(5):
        answer = httpx.put(
            f"http://127.0.0.1:{at}/v1/subjects/person-{number}/enrollment",
            files=images(photo(number)), headers=bearer(deployment.token), timeout=PATIENCE_S,
        )  # fmt: skip
        assert answer.status_code == 201
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    with listening(Endpoint(port)) as endpoint:
        process = start()
        try:
            expected = {f"person-{number}" for number in range(5)}
            wait_until(
                lambda: {each["data"]["subject_id"] for each in endpoint.events()} == expected
            )
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE_S)
    assert "whsec_" not in (tmp_path / "serve.log").read_text()
    assert b"person-" not in (tmp_path / "serve.log").read_bytes()


def test_a_command_of_the_operator_tells_too(tmp_path: Path) -> None:
    deployment = telling(tmp_path, "http://127.0.0.1:9/events")
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        assert store.outbox.waiting() == 0
    finally:
        store.close()
    done = subprocess.run(
        [str(VEILFACE), "enroll", "ann", "ann.png"], cwd=tmp_path, check=False,
        env=os.environ | environment_of(deployment.settings), capture_output=True,
        input=(tmp_path / "ann.png").write_bytes(photo(1)) and b"",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        assert store.outbox.waiting() == 1
    finally:
        store.close()


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[tuple[str, "subprocess.Popen[str]"]]:
    """The receiver of the page, as a process."""
    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-W", "error", "-c", program],
        env={"SECRET": LINE, "PORT": str(port), "PATH": os.environ["PATH"]},
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    url = f"http://127.0.0.1:{port}/"
    with process:
        try:
            wait_until(lambda: process.poll() is None and _answers(url))
            yield url, process
        finally:
            process.terminate()


def _answers(url: str) -> bool:
    try:
        return httpx.get(url, timeout=5).status_code == 501
    except httpx.TransportError:
        return False


def sent(url: str, by: Sequence[bytes], event: Event) -> bool:
    async def work() -> bool:
        async with httpx.AsyncClient() as http:
            return await send(http, url, by, event)

    return anyio.run(work)


def test_the_receiver_of_the_page_takes_ours_alone(
    receiver: tuple[str, "subprocess.Popen[str]"],
) -> None:
    url, process = receiver
    body = json.dumps({"type": "subject.erased", "data": {"subject_id": "ann"}})
    event = Event(secrets.token_hex(16), body, 1, datetime.now(UTC))
    assert sent(url, [SECRET], event)
    assert sent(url, [b"n" * 32, SECRET], event), "it knows the one before"
    assert not sent(url, [b"n" * 32], event)
    with httpx.Client(timeout=PATIENCE_S) as http:
        old = {"webhook-id": "x", "webhook-timestamp": "1700000000"}
        old["webhook-signature"] = signatures([SECRET], "x", 1700000000, body)
        assert http.post(url, content=body, headers=old).status_code == 401
        assert http.post(url, content=body).status_code == 401
    process.terminate()
    assert process.stdout is not None
    assert process.stdout.read() == "subject.erased ann\n", "the same event counts once"


@pytest.mark.parametrize(
    "url",
    ["ftp://a.org", "https://", "//a.org", "https://u:p@a.org", "a", "https://a..b/x",
     "https://h:abc/", "https://h:0/", "https://h:70000/", "https://a b/", "https://a/ b",
     "https://[::1/", "https://\u00e9.org/", "https://" + "a" * 64 + ".org/", "https://a\\b/",
     "http://a.org/", "http://10.0.0.1/", "http://localhost.evil.org/"],
)  # fmt: skip
def test_a_url_that_nothing_can_be_sent_to_is_refused(url: str) -> None:
    with pytest.raises(StartError, match="webhook_url"):
        load_settings(webhook_url=url, webhook_secret_file="secret")


@pytest.mark.parametrize(
    "url",
    ["https://a.org", "https://xn--9ca.org:8443/x?y=z@a", "https://[2001:db8::1]/", "https://a_b/",
     "http://localhost/x", "http://127.0.0.1:9/x", "http://[::1]:8000/"],
)  # fmt: skip
def test_a_url_that_can_be_sent_to_is_taken(url: str) -> None:
    assert load_settings(webhook_url=url, webhook_secret_file="secret").webhook_url == url
    assert httpx.URL(url).host


def test_the_two_settings_come_together() -> None:
    for half in ({"webhook_url": "https://a.org"}, {"webhook_secret_file": "secret"}):
        with pytest.raises(StartError, match="give webhook_url and webhook_secret_file"):
            load_settings(**half)


def test_a_secret_file_is_private_and_holds_secrets(tmp_path: Path) -> None:
    path = secret_file(tmp_path)
    assert read_webhook_secrets(path) == (SECRET,)
    path.write_text(f"{LINE}\n\nwhsec_{base64.b64encode(b'x' * 24).decode()}\n")
    assert read_webhook_secrets(path) == (SECRET, b"x" * 24)
    path.chmod(0o644)
    with pytest.raises(SealError, match="may be read by others"):
        read_webhook_secrets(path)
    path.chmod(0o600)
    for text in ("", "whsec_", "whsec_YQ==", "no base64!", f"{LINE}\n" * 100):
        path.write_text(text)
        with pytest.raises(SealError) as refused:
            read_webhook_secrets(path)
        assert LINE not in str(refused.value)
    with pytest.raises(SealError, match="No such file"):
        read_webhook_secrets(tmp_path / "absent")
