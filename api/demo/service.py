"""``veilface serve`` as a process of its own, for the demo."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

from api.http.errors import StartError

# A first start compiles the distance kernels.
START_TIMEOUT_S = 120.0


@contextlib.contextmanager
def running_service(folder: Path, token: str) -> Iterator[httpx.Client]:
    """Start ``veilface serve`` on a free local port; a client with the API key ``token``.

    The service ends with the block, also where this process is ended by SIGTERM.
    """
    port = _free_port()
    log = folder / "serve.log"
    settings = folder / "veilface.toml"
    command = [sys.executable, "-P", "-m", "veilface", "serve"]
    # Settings of the person who runs the demo must not reach it. It shows more strangers than any
    # lockout or limit lets through.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")} | {
        f"VEILFACE_{name}": value
        for name, value in (
            ("LOCKOUT_AFTER", "0"),
            ("RATE_LIMIT_KEY", "off"),
            ("RATE_LIMIT_ADDRESS", "off"),
        )
    }
    with log.open("wb") as output:
        before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
        process = subprocess.Popen(  # noqa: S603 - our own command, no shell
            [*command, "--config", str(settings), "--port", str(port)],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
        )
        try:
            url = f"http://127.0.0.1:{port}"
            _await_ready(process, url, log)
            headers = {"Authorization": f"Bearer {token}"}
            with httpx.Client(base_url=url, headers=headers, timeout=30.0) as client:
                yield client
        finally:
            process.send_signal(signal.SIGTERM)
            signal.signal(signal.SIGTERM, before)
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _await_ready(process: "subprocess.Popen[bytes]", url: str, log: Path) -> None:
    deadline = time.monotonic() + START_TIMEOUT_S
    with httpx.Client(base_url=url, timeout=2.0) as client:
        while time.monotonic() < deadline:
            if process.poll() is not None:
                raise StartError(f"the service stopped at its start; {log} says why")
            with contextlib.suppress(httpx.TransportError):
                if client.get("/health/ready").status_code == httpx.codes.OK:
                    return
            time.sleep(0.1)
    raise StartError(f"the service was not ready in {START_TIMEOUT_S:.0f} s; {log} says why")
