"""Readiness that is honest, a port for operations, TLS, and a bound on what is in flight."""

import http.client
import json
import re
import signal
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
import sqlalchemy as sa
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from api.http.app import create_app
from api.http.context import RequestContext, _Body
from api.http.errors import StartError
from api.service.metrics import IN_FLIGHT, MODEL_UP, STORE_UP
from api.service.operations import OPERATIONS_PATHS, operations_server, tls_options
from api.settings import Settings, load_settings
from models.errors import ModelError
from templates.store import TemplateStore
from tests.api.client import Client
from tests.api.deployment import Deployment, bearer, deploy, environment_of, images, photo
from tests.api.service.test_server import in_flight
from tests.api.shapes import assert_error
from tests.certificates import self_signed
from tests.patience import PATIENCE_S, wait_until
from tests.ports import free_port
from veilface import healthcheck

READY = "/health/ready"


# Readiness


def refuse_writes(store: TemplateStore, *tables: str) -> None:
    """Let the database itself refuse to write, as one does that is full or read-only."""

    def work(connection: sa.Connection) -> None:
        if connection.dialect.name != "sqlite":
            connection.execute(
                sa.text(
                    "CREATE FUNCTION no_room() RETURNS trigger LANGUAGE plpgsql AS "
                    "$$ BEGIN RAISE EXCEPTION USING ERRCODE = '53100'; END $$"
                )
            )
        for table in tables:
            for event in ("INSERT", "UPDATE"):
                does = (
                    "BEGIN SELECT RAISE(ABORT, 'full'); END"
                    if connection.dialect.name == "sqlite"
                    else "FOR EACH ROW EXECUTE FUNCTION no_room()"
                )
                name = f"full_{table}_{event}"
                connection.execute(
                    sa.text(f"CREATE TRIGGER {name} BEFORE {event} ON {table} {does}")
                )

    store.database.write(work)


def take_writes(store: TemplateStore, *tables: str) -> None:
    def work(connection: sa.Connection) -> None:
        for table in tables:
            for event in ("INSERT", "UPDATE"):
                on = "" if connection.dialect.name == "sqlite" else f" ON {table}"
                connection.execute(sa.text(f"DROP TRIGGER full_{table}_{event}{on}"))

    store.database.write(work)


def test_after_a_failed_write_a_write_must_succeed(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    store = client.app.state.runtime.store
    enroll = {"path": "/v1/subjects/a/enrollment", "files": images(photo(1))}
    assert client.get(READY).status_code == 200
    tables = ("templates", "secrets")
    refuse_writes(store, *tables)
    # Nobody has tried to write yet: a database that answers is taken for one that works.
    assert client.get(READY).status_code == 200
    assert_error(client.put(**enroll), 503, "store_unavailable")
    assert STORE_UP._value.get() == 0
    for _ in range(2):
        assert_error(client.get(READY), 503, "store_unavailable")
    assert client.get("/health/live").status_code == 200
    assert client.get("/v1/subjects").status_code == 200  # reading still works
    take_writes(store, *tables)
    assert client.get(READY).status_code == 200
    assert STORE_UP._value.get() == 1
    assert client.put(**enroll).status_code == 201


def test_a_trial_write_changes_nothing(both: tuple[Client, Deployment]) -> None:
    client, _ = both
    store = client.app.state.runtime.store
    row = sa.text("SELECT * FROM secrets ORDER BY name")

    def rows() -> list[Any]:
        return store.database.read(lambda each: [tuple(r) for r in each.execute(row)])

    before = rows()
    store.ping_write()
    assert rows() == before
    assert before


def test_after_a_failed_inference_one_must_succeed(
    client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    pack = client.app.state.runtime.pack
    assert client.put("/v1/subjects/a/enrollment", files=images(photo(1))).is_success
    verify = {"path": "/v1/subjects/a/verify", "files": images(photo(1), name="image")}
    inferences = 0
    embed = type(pack).embed

    def counted(self: Any, *given: Any, **named: Any) -> Any:
        nonlocal inferences
        inferences += 1
        return embed(self, *given, **named)

    def broken(*_: Any, **__: Any) -> None:
        raise ModelError("out of memory")

    with monkeypatch.context() as patch:
        patch.setattr(type(pack), "embed", broken)
        assert_error(client.post(**verify), 503, "model_unavailable")
        assert MODEL_UP._value.get() == 0
        assert_error(client.get(READY), 503, "model_unavailable")
    monkeypatch.setattr(type(pack), "embed", counted)
    assert client.get(READY).status_code == 200
    assert (inferences, MODEL_UP._value.get()) == (1, 1)
    assert client.get(READY).status_code == 200
    assert inferences == 1  # a model that works is not asked each time


def test_a_mistake_of_the_client_does_not_make_the_service_unready(client: Client) -> None:
    for answer in (
        client.put("/v1/subjects/a/enrollment", files=images(b"no picture")),
        client.get("/v1/subjects/a%20b"),
        client.get("/v1/subjects/nobody"),
    ):
        assert 400 <= answer.status_code < 500
    assert STORE_UP._value.get() == MODEL_UP._value.get() == 1
    assert client.get(READY).status_code == 200


def test_recovery_is_seen_without_anybody_asking(
    deployment: Deployment, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "api.service.operations.Readiness.watch.__kwdefaults__", {"every_s": 0.05}, raising=False
    )
    with Client(create_app(deployment.settings)) as client:
        store = client.app.state.runtime.store
        refuse_writes(store, "secrets")
        client.app.state.readiness.note(_store_error())
        time.sleep(0.3)
        assert STORE_UP._value.get() == 0
        take_writes(store, "secrets")
        wait_until(lambda: STORE_UP._value.get() == 1, what="the store's recovery")
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    said = [line["event"] for line in lines if line["event"].startswith("store")]
    assert said == ["store failed", "store is available again"]


def _store_error() -> Exception:
    from templates.errors import StoreUnavailable

    return StoreUnavailable("gone")


def test_a_worker_that_stops_is_not_ready(deployment: Deployment) -> None:
    with Client(create_app(deployment.settings)) as client:
        client.app.state.readiness.stopping = True
        assert assert_error(client.get(READY), 503, "overloaded") == {"stopping": True}
        assert client.get("/health/live").status_code == 200


# What is in flight


def test_a_request_too_many_is_refused_before_anything_of_it_is_read(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, max_in_flight=2)
    go_on = anyio.Event()
    read = 0

    async def slow() -> AsyncIterator[bytes]:
        yield b'{"export": "'
        await go_on.wait()
        yield b'x"}'

    async def counted() -> AsyncIterator[bytes]:
        nonlocal read
        read += 1
        yield b"{}"

    async def scenario() -> None:
        app = create_app(deployment.settings)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client,
        ):

            async def post(body: AsyncIterator[bytes]) -> httpx.Response:
                return await client.post(
                    "/v1/subjects/import",
                    content=body,
                    headers={"Content-Type": "application/json", **bearer(deployment.token)},
                )

            async with anyio.create_task_group() as tasks:
                for _ in range(2):
                    tasks.start_soon(post, slow())
                while IN_FLIGHT._value.get() < 2:
                    await anyio.sleep(0.01)
                refused = await post(counted())
                assert_error(refused, 503, "overloaded")
                assert read == 0
                for path in OPERATIONS_PATHS:
                    assert (await client.get(path)).status_code == 200
                text = (await client.get("/metrics")).text
                assert "veilface_requests_in_flight 2.0" in text
                go_on.set()
            answer = await post(counted())
            assert answer.status_code == 422
            assert read == 1
            assert "veilface_requests_in_flight 0.0" in (await client.get("/metrics")).text

    anyio.run(scenario)


@pytest.mark.parametrize(("most", "leave"), [(40, 0), (4, 2)])
def test_who_has_no_key_does_not_hold_a_crowded_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, leave: int
) -> None:
    """Two of four leave at once where four is all there is room for; elsewhere each has time."""
    monkeypatch.setattr("api.http.context.LINGER_S", PATIENCE_S)
    deployment = deploy(tmp_path, max_in_flight=most)
    linger = _Body.linger
    left, lingering = 0, 0

    async def counted(body: _Body) -> None:
        nonlocal lingering
        lingering += 1
        await linger(body)

    monkeypatch.setattr(_Body, "linger", counted)

    async def endless() -> AsyncIterator[bytes]:
        yield b"{"
        await anyio.sleep_forever()

    async def scenario() -> None:
        app = create_app(deployment.settings)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client,
        ):

            async def post() -> None:
                nonlocal left
                answer = await client.post("/v1/subjects/import", content=endless())
                assert_error(answer, 401, "unauthorized")
                left += 1

            async with anyio.create_task_group() as tasks:
                for _ in range(4):
                    tasks.start_soon(post)
                while left + lingering < 4:
                    await anyio.sleep(0.01)
                assert (left, lingering) == (leave, 4 - leave)
                tasks.cancel_scope.cancel()
            # The time that each has ends.
            monkeypatch.setattr("api.http.context.LINGER_S", 0.05)
            await post()
            assert (left, lingering) == (leave + 1, 5 - leave)

    anyio.run(scenario)


def test_health_has_a_bound_of_its_own() -> None:
    go_on, answered = anyio.Event(), []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await go_on.wait()
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def scenario() -> None:
        context = RequestContext(app, max_in_flight=1, operations_paths=OPERATIONS_PATHS)
        async with httpx.AsyncClient(
            transport=httpx.ASGITransport(context), base_url="http://test"
        ) as client:

            async def ask() -> None:
                answered.append((await client.get("/metrics")).status_code)

            async with anyio.create_task_group() as tasks:
                for _ in range(70):
                    tasks.start_soon(ask)
                while len(answered) < 6:
                    await anyio.sleep(0.01)
                go_on.set()

    anyio.run(scenario)
    assert sorted(answered) == [200] * 64 + [503] * 6


# The port for operations


def test_operations_are_on_their_port_only(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, operations_port=0)
    with Client(create_app(deployment.settings)) as client:
        for path in sorted(OPERATIONS_PATHS):
            assert_error(client.get(path), 404, "not_found")
        beside = f"http://127.0.0.1:{client.app.state.operations_port}"
        for path in sorted(OPERATIONS_PATHS):
            answer = httpx.get(f"{beside}{path}", timeout=PATIENCE_S)
            assert answer.status_code == 200
            assert answer.headers["x-content-type-options"] == "nosniff"
        assert httpx.get(f"{beside}{READY}", timeout=PATIENCE_S).json()["status"] == "ok"
        for path in ("/v1/contract", "/v1/openapi.json", "/docs"):
            assert_error(
                httpx.get(f"{beside}{path}", headers=bearer(deployment.token), timeout=PATIENCE_S),
                404,
                "not_found",
            )
        assert not any(path in client.app.openapi()["paths"] for path in OPERATIONS_PATHS)
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{beside}/health/live", timeout=PATIENCE_S)


def test_metrics_are_documented_where_they_are_served() -> None:
    assert set(create_app(Settings()).openapi()["paths"]) >= OPERATIONS_PATHS


def test_a_taken_port_is_named() -> None:
    async def scenario(port: int) -> None:
        async with operations_server(lambda *_: None, host="127.0.0.1", port=port):
            pass

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(StartError, match="operations_port"):
            anyio.run(scenario, taken.getsockname()[1])


@contextmanager
def serving(
    folder: Path, deployment: Deployment, url: str, **options: Any
) -> Iterator["subprocess.Popen[bytes]"]:
    """Run ``veilface serve`` until ``url`` answers, and through the test."""
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve"],
            cwd=Path(__file__).resolve().parents[3],
            env=environment_of(deployment.settings),
            stdout=log,
            stderr=log,
        )
    try:

        def ready() -> bool:
            assert process.poll() is None, (folder / "log").read_text()
            with suppress(httpx.TransportError):
                return httpx.get(url, **options, timeout=PATIENCE_S).status_code == 200
            return False

        wait_until(ready, what="a service that is ready")
        yield process
    finally:
        process.kill()
        process.wait()


@pytest.mark.long
def test_workers_share_the_port_and_say_that_they_stop(tmp_path: Path) -> None:
    port, beside = free_port(), free_port()
    deployment = deploy(tmp_path, workers=2, port=port, operations_port=beside, compute_slots=1)
    ready = f"http://127.0.0.1:{beside}{READY}"
    with serving(tmp_path, deployment, ready) as process:
        assert (
            httpx.get(f"http://127.0.0.1:{port}/v1/openapi.json", timeout=PATIENCE_S).status_code
            == 200
        )
        assert httpx.get(f"http://127.0.0.1:{port}{READY}", timeout=PATIENCE_S).status_code == 404
        told = f"Health and metrics are on http://127.0.0.1:{beside}"
        wait_until(lambda: told in (tmp_path / "log").read_text(), what="both workers ready")
        held: list[socket.socket] = []
        for _ in range(8):  # so that both workers have a request in progress
            raw = socket.create_connection(("127.0.0.1", port))
            raw.sendall(
                b"POST /v1/subjects/import HTTP/1.1\r\nHost: x\r\n"
                + f"Authorization: Bearer {deployment.token}\r\n".encode()
                + b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{"
            )
            held.append(raw)
        wait_until(lambda: in_flight(f"http://127.0.0.1:{beside}") == 8, what="all eight")
        process.send_signal(signal.SIGTERM)

        def stopping() -> bool:
            assert process.poll() is None
            with suppress(httpx.TransportError):
                answer = httpx.get(ready, timeout=PATIENCE_S)
                return answer.status_code == 503 and assert_error(answer, 503, "overloaded") == {
                    "stopping": True
                }
            return False

        def refused() -> bool:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
            except ConnectionRefusedError:
                return True
            return False

        wait_until(stopping, what="a worker that says that it stops")
        wait_until(refused, what="a port that nobody listens on")
        assert in_flight(f"http://127.0.0.1:{beside}") == 8
        for raw in held:
            raw.close()
        assert process.wait(timeout=PATIENCE_S) == 0
    assert "Traceback" not in (tmp_path / "log").read_text()


# TLS


HEALTHCHECK = Path(__file__).resolve().parents[3] / "deploy/Dockerfile"


def container_says(deployment: Deployment) -> int:
    """Exit status of the Dockerfile's HEALTHCHECK beside a service with these settings."""
    (command,) = re.findall(r"^HEALTHCHECK .*\\\n +CMD (.*)$", HEALTHCHECK.read_text(), re.M)
    python, *arguments = json.loads(command)
    assert python == "python"
    return subprocess.run(
        [sys.executable, *arguments],
        check=False,
        # Where there is a proxy, it is none for the machine itself.
        env={**environment_of(deployment.settings), "http_proxy": "http://127.0.0.1:9"},
    ).returncode


@pytest.mark.long
@pytest.mark.parametrize("tls", [False, True])
@pytest.mark.parametrize("apart", [False, True])
def test_the_containers_health_check_finds_the_service(
    tmp_path: Path, tls: bool, apart: bool
) -> None:
    certificate, key = self_signed(tmp_path / "tls")
    files = {"tls_certificate": certificate, "tls_key": key} if tls else {}
    port, beside = free_port(), free_port()
    if apart:
        files["operations_port"] = beside
    deployment = deploy(tmp_path, host="0.0.0.0", port=port, **files)
    assert container_says(deployment) == 1
    trust = ssl.create_default_context(cafile=str(certificate))
    url = f"https://127.0.0.1:{port}" if tls else f"http://127.0.0.1:{port}"
    ready = f"http://127.0.0.1:{beside}" if apart else url
    with serving(tmp_path, deployment, f"{ready}{READY}", verify=trust):
        assert container_says(deployment) == 0


def test_the_health_check_reads_the_settings_as_the_service_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    declared = {name: Settings.model_fields[name].default for name in healthcheck.DEFAULTS}
    assert declared == healthcheck.DEFAULTS
    monkeypatch.chdir(tmp_path)
    (tmp_path / "veilface.toml").write_text('host = "::"\nport = 9\ntls_certificate = "a"\n')
    monkeypatch.setenv("VEILFACE_OPERATIONS_PORT", "")
    monkeypatch.setenv("VEILFACE_PORT", "10")
    asked = healthcheck.connection()
    assert isinstance(asked, http.client.HTTPSConnection)
    assert (asked.host, asked.port) == ("::1", 10)
    monkeypatch.setenv("VEILFACE_CONFIG", str(tmp_path / "other.toml"))
    (tmp_path / "other.toml").write_text("operations_port = 11\n")
    asked = healthcheck.connection()
    assert not isinstance(asked, http.client.HTTPSConnection)
    assert (asked.host, asked.port) == ("127.0.0.1", 11)


def test_the_service_speaks_tls(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path / "tls")
    port = free_port()
    deployment = deploy(tmp_path, port=port, tls_certificate=certificate, tls_key=key)
    url, trust = f"https://127.0.0.1:{port}", ssl.create_default_context(cafile=str(certificate))
    with serving(tmp_path, deployment, f"{url}{READY}", verify=trust):
        wait_until(
            lambda: f"listens on {url}" in (tmp_path / "log").read_text(), what="the address"
        )
        answer = httpx.get(
            f"{url}/v1/contract", verify=trust, headers=bearer(deployment.token), timeout=PATIENCE_S
        )
        assert answer.status_code == 200
        assert answer.headers["strict-transport-security"] == "max-age=31536000"
        assert container_says(deployment) == 0
        with pytest.raises(httpx.ConnectError):
            httpx.get(
                f"{url}/health/live", timeout=PATIENCE_S
            )  # nobody vouches for the certificate
        with pytest.raises(httpx.TransportError):
            httpx.get(f"http://127.0.0.1:{port}/health/live", timeout=PATIENCE_S)
        old = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        old.load_verify_locations(certificate)
        old.maximum_version = ssl.TLSVersion.TLSv1_2
        old.set_ciphers("AES128-SHA:AES256-SHA:ECDHE-ECDSA-AES256-SHA")
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"{url}/health/live", verify=old, timeout=PATIENCE_S)
        old.set_ciphers("ECDHE-ECDSA-AES128-GCM-SHA256")
        assert httpx.get(f"{url}/health/live", verify=old, timeout=PATIENCE_S).status_code == 200


def test_without_tls_no_header_asks_for_it(client: Client) -> None:
    assert "strict-transport-security" not in client.get("/health/live").headers


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    for mode in (0o640, 0o604, 0o660):
        certificate, key = self_signed(tmp_path, mode=mode)
        with pytest.raises(StartError, match="chmod 600") as caught:
            tls_options(load_settings(tls_certificate=certificate, tls_key=key))
        assert f"{mode:04o}" in str(caught.value)


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    certificate, _ = self_signed(tmp_path / "one")
    _, other = self_signed(tmp_path / "other")
    encrypted = tmp_path / "encrypted.pem"
    encrypted.write_bytes(
        ec.generate_private_key(ec.SECP256R1()).private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"hunter2"),
        )
    )
    encrypted.chmod(0o600)
    for key, sentence in (
        (other, "belong together"),
        (encrypted, "without a password"),
        (tmp_path / "absent", "exist"),
    ):
        with pytest.raises(StartError, match=sentence):
            tls_options(load_settings(tls_certificate=certificate, tls_key=key))


def test_a_certificate_needs_a_key_and_a_key_a_certificate(tmp_path: Path) -> None:
    for half in ({"tls_certificate": "a"}, {"tls_key": "a"}):
        with pytest.raises(StartError, match="or neither"):
            load_settings(**half)
