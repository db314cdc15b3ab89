"""The command ``veilface-client`` against a running service."""

import json
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest

import veilface_client
from tests.api.deployment import photo
from tests.clients.conftest import Running
from tests.patience import PATIENCE_S
from tests.ports import free_port
from veilface_client import Client
from veilface_client.command import main


@pytest.fixture
def photos(tmp_path: Path) -> list[str]:
    """Two photos of one person, and one of another."""
    paths = [tmp_path / f"{number}.png" for number in range(3)]
    for path, shown in zip(paths, (photo(1, 0), photo(1, 1), photo(2, 0)), strict=True):
        path.write_bytes(shown)
    return [str(path) for path in paths]


@pytest.fixture(autouse=True)
def environment(service: Running, token: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VEILFACE_API_KEY", token)
    monkeypatch.setenv("VEILFACE_URL", service.url)


def test_enroll_then_accept_and_reject(
    service: Running, token: str, photos: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["enroll", "cleo", photos[0], "--no-replace", "--json"]) == 0
    first = json.loads(capsys.readouterr().out)
    assert first["replaced"] is False
    assert main(["enroll", "cleo", photos[0], "--no-replace"]) == 3
    refused = capsys.readouterr()
    assert refused.out == ""
    assert refused.err.startswith("error: the subject is enrolled, with another template")
    assert main(["enroll", "cleo", photos[0], "--replace", first["template_id"]]) == 0
    assert capsys.readouterr().out.startswith("Replaced the enrollment of cleo from 1 photos")

    assert main(["verify", "cleo", photos[1], "--level", "fmr-1e-2"]) == 0
    assert capsys.readouterr().out == "accept: cleo, level fmr-1e-2\n"
    assert main(["verify", "cleo", photos[2], "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["decision"] == "reject"
    with Client(service.url, token) as client:
        client.erase("cleo")


def test_no_decision_is_no_rejection(
    photos: list[str], tmp_path: Path, token: str, capsys: pytest.CaptureFixture[str]
) -> None:
    nowhere = f"http://127.0.0.1:{free_port()}"
    for arguments, said in (
        (["verify", "nobody", photos[0]], "not_enrolled"),
        (["verify", "../x", photos[0]], "a subject id has"),
        (["verify", "cleo", photos[0], "--url", nowhere], "the service was not reached"),
    ):
        assert main(arguments) == 3
        told = capsys.readouterr()
        assert told.out == ""
        assert said in told.err
        assert token not in told.err


def test_a_lost_answer_is_not_called_undone(
    photos: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def receive_and_hang_up() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(1)

        thread = threading.Thread(target=receive_and_hang_up)
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        assert main(["verify", "cleo", photos[0], "--url", url]) == 3
        thread.join()
    assert "the service may have done what was asked" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("missing", "said"),
    [("VEILFACE_API_KEY", "the API key is missing"), ("VEILFACE_URL", "the service is missing")],
)
def test_what_is_missing_is_named(
    missing: str, said: str, photos: list[str], monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.delenv(missing)
    with pytest.raises(SystemExit) as ended:
        main(["verify", "cleo", photos[0]])
    assert ended.value.code == 2
    assert said in capsys.readouterr().err


def test_a_missing_photo_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["verify", "cleo", str(tmp_path / "absent.png")])
    assert ended.value.code == 2
    assert "no such photo: " in capsys.readouterr().err


@pytest.mark.parametrize("answered", [b"HTTP/1.1 200 OK\r\nx-slow: ", b"HTTP/1.1 200 OK\r\n\r\n"])
def test_an_answer_that_comes_byte_by_byte_ends_at_the_time_limit(
    answered: bytes, photos: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def drip() -> None:
            with suppress(OSError), listener.accept()[0] as connection:
                connection.sendall(answered)
                while True:
                    connection.sendall(b" ")
                    time.sleep(0.05)

        listener.settimeout(PATIENCE_S)
        thread = threading.Thread(target=drip)
        thread.start()
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        assert main(["verify", "cleo", photos[0], "--url", url, "--timeout", "1"]) == 3
        thread.join()
    assert "no answer within 1 s" in capsys.readouterr().err


def test_the_status_is_the_decision_where_nobody_reads_it(
    service: Running, token: str, photos: list[str]
) -> None:
    read, write = os.pipe()
    os.close(read)
    with Client(service.url, token) as client:
        client.enroll("dido", photos[0])
        done = subprocess.run(
            [sys.executable, "-P", "-m", "veilface_client", "verify", "dido", photos[1]],
            stdout=write, stderr=subprocess.PIPE, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        client.erase("dido")
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")


def test_the_version_is_the_distributions(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--version"])
    assert capsys.readouterr().out == f"{veilface_client.__version__}\n"
