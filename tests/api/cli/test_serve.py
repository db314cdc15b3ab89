"""``serve`` as its own process, as an operator starts it."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from models.demo import DEMO_NOTICE
from tests.api.cli.conftest import Ran, key_file, run
from tests.patience import PATIENCE_S


def warnings(ran: Ran) -> list[str]:
    return [line for line in ran.stderr.splitlines() if line.startswith("warning: ")]


@contextmanager
def started(folder: Path, *arguments: str) -> Iterator[tuple["subprocess.Popen[bytes]", str]]:
    """Start the service and wait until it listens; hand out the process and its URL."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
    with (folder / "out").open("w") as output, (folder / "err").open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve", "--port", "0", *arguments],
            env={**environment, "PYTHONUNBUFFERED": "1"},
            stdout=output,
            stderr=errors,
        )
    try:
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline and process.poll() is None:
            told = (folder / "err").read_text()
            if "listens on " in told:
                url = told.split("listens on ", 1)[1].split()[0]
                try:
                    if httpx.get(f"{url}/health/ready", timeout=PATIENCE_S).status_code == 200:
                        yield process, url
                        return
                except httpx.TransportError:
                    pass
            time.sleep(0.1)
        raise AssertionError((folder / "err").read_text())
    finally:
        process.kill()
        process.wait()


def test_it_serves_prints_no_key_and_ends_by_sigterm(world, data, tmp_path):
    common = ("--data-dir", str(data), "--pack", str(world.pack))
    assert "`veilface keys create --out FILE` makes one" in run("serve", "--check", *common).stderr
    made = run("keys", "create", "--right", "verify", "--data-dir", str(data), "--json")
    token = made.json["token"]
    with started(tmp_path, *common) as (process, url):
        answer = httpx.get(
            f"{url}/v1/contract", headers={"Authorization": f"Bearer {token}"}, timeout=PATIENCE_S
        )
        assert answer.status_code == 200
        assert answer.headers["x-veilface-notice"] == DEMO_NOTICE
        assert httpx.get(f"{url}/v1/contract", timeout=PATIENCE_S).status_code == 401
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=PATIENCE_S) in (0, -signal.SIGTERM)
    log = (tmp_path / "err").read_text()
    assert DEMO_NOTICE in log
    assert "vf_" not in log + (tmp_path / "out").read_text()
    assert "Traceback" not in log

    again = run("serve", "--check", *common)
    assert again.status == 0
    assert "API key" not in again.stderr
    assert not warnings(again)
    assert "Privacy: not proven. " in again.stderr


def test_a_master_key_beside_the_database_is_used_with_a_warning(world, data):
    check = ("serve", "--check", "--data-dir", data, "--pack", world.pack)
    key_file(data).rename(data / "master.key")
    ran = run(*check, "--master-key-file", data / "master.key")
    assert ran.status == 0, ran.stderr
    (warning,) = warnings(ran)
    assert f"{data / 'master.key'} lies in the folder of the database" in warning
    (data / "master.key").rename(key_file(data))
    moved = run(*check)
    assert moved.status == 0, moved.stderr
    assert not warnings(moved)


def test_what_does_not_fit_stops_the_start_with_a_sentence(world, data, tmp_path):
    absent = run("serve", "--data-dir", tmp_path / "empty")
    assert absent.status == 1
    assert "veilface calibrate" in absent.stderr
    (data / "contract.json").write_text("{}")
    broken = run("serve", "--data-dir", data, "--pack", world.pack)
    assert broken.status == 1
    assert broken.stderr.startswith("error: the contract file")
    assert "Traceback" not in broken.stderr


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (("--tls-certificate", "absent.pem", "--tls-key", "absent.pem"), "they must be PEM files"),
        (("--rate-limit-storage", "redis://user:hunter2@host:port/x"), "rate_limit_storage"),
    ],
)
def test_the_check_looks_at_the_tls_key_and_the_rate_limit_storage(world, data, flags, sentence):
    ran = run("serve", "--check", "--data-dir", data, "--pack", world.pack, *flags)
    assert ran.status == 1
    assert sentence in ran.stderr
    assert "hunter2" not in ran.stderr


def test_a_taken_port_is_named(world, data):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        ran = run("serve", "--data-dir", data, "--pack", world.pack, "--port", str(port))
    assert ran.status == 1
    assert f"cannot listen on 127.0.0.1:{port}" in ran.stderr


@pytest.mark.parametrize("arguments", [("--help",), ("db", "upgrade", "--json")])
def test_the_module_is_the_command(tmp_path, arguments):
    ran = subprocess.run(
        [sys.executable, "-m", "veilface", *arguments],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "VEILFACE_DATA_DIR": str(tmp_path)},
    )
    assert ran.returncode == 0
    assert ran.stderr == ""
