"""``veilface serve`` as a process of its own, for tests and for benchmarks."""

import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx

from tests.patience import PATIENCE_S
from tests.ports import free_port


@contextmanager
def serve(
    env: Mapping[str, str], log: Path, *, workers: int = 1
) -> Iterator[tuple[str, "subprocess.Popen[bytes]"]]:
    """Start a service on a free port; yields its URL and process once it is ready."""
    port = free_port()
    command = [sys.executable, "-m", "veilface", "serve", "--port", str(port)]
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [*command, "--workers", str(workers)], env=env, stdout=sink, stderr=sink
        )
        url = f"http://127.0.0.1:{port}"
        try:
            end = time.monotonic() + PATIENCE_S
            while not _is_ready(url):
                if process.poll() is not None or time.monotonic() > end:
                    raise RuntimeError(f"the service is not ready: {log.read_text()[-2000:]}")
                time.sleep(0.1)
            yield url, process
        finally:
            process.terminate()
            process.wait()


def _is_ready(url: str) -> bool:
    try:
        return httpx.get(f"{url}/health/ready", timeout=5).status_code == 200
    except httpx.TransportError:
        return False
