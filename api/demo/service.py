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
def running_service(folder: Path) -> Iterator[httpx.Client]:
    """Start ``veilface serve`` on a free local port; a client with the bootstrap key.

    The service ends with the block, also where this process is ended by SIGTERM.
    """
    port = _free_port()
    log, shown = folder / "serve.log", folder / "serve.out"
    command = [
        sys.executable,
        "-P",
        "-m",
        "veilface",
        "serve",
        "--config",
        str(folder / "veilface.toml"),
    ]
    # Settings of the person who runs the demo must not reach it.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
    shown.unlink(missing_ok=True)
    # The first start prints a token with all rights: nobody else may read it on its way.
    with log.open("wb") as errors, open(shown, "xb", opener=_privately) as output:
        before = signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
        process = subprocess.Popen(  # noqa: S603 - our own command, no shell
            [*command, "--config", str(folder / "veilface.toml"), "--port", str(port)],
            stdout=output,
            stderr=errors,
            env={**environment, "PYTHONUNBUFFERED": "1"},
        )
        try:
            url = f"http://127.0.0.1:{port}"
            _await_ready(process, url, log)
            token = next(line for line in shown.read_text().splitlines() if line.startswith("vf_"))
            shown.unlink()
            _write_token(folder / "api-key", token)
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
            shown.unlink(missing_ok=True)


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


def _privately(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _write_token(path: Path, token: str) -> None:
    with open(path, "x", opener=_privately) as file:
        file.write(token + "\n")
