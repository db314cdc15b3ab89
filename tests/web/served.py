"""`veilface serve` as a process of its own, for a browser to visit."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from api.service.opening import open_keyring, open_store
from api.settings import Settings
from templates.store.api_keys import Right
from tests.patience import PATIENCE_S
from tests.ports import free_port


@dataclass
class Served:
    """A running service."""

    url: str
    token: str = field(repr=False)
    settings: Settings
    log: Path

    def key(self, *rights: str) -> str:
        """Make another API key; return its token."""
        store = open_store(self.settings, open_keyring(self.settings))
        try:
            store.tenants.create("default")
            return store.api_keys.create("default", rights).token
        finally:
            store.close()

    def client(self) -> httpx.Client:
        """A client with all rights."""
        return httpx.Client(
            base_url=self.url, headers={"Authorization": f"Bearer {self.token}"}, timeout=PATIENCE_S
        )


@contextmanager
def serving(
    folder: Path, settings: Settings, *options: str, token: str | None = None, **named: str
) -> Iterator[Served]:
    """Start the command with options and variables; without a token, make one of all rights."""
    port = free_port()
    log = folder / "page.log"
    # Every tab asks for the whole page anew: dozens a minute are more than one address may.
    options = (*options, "--port", str(port))
    named = {"VEILFACE_RATE_LIMIT_ADDRESS": "off", **named}
    environment = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve", *options],
            stdout=subprocess.DEVNULL,
            stderr=errors,
            env={**environment, **named, "PYTHONUNBUFFERED": "1", "OMP_NUM_THREADS": "1"},
        )
    try:
        url = f"http://127.0.0.1:{port}"
        _wait(process, url, log)
        if token is None:
            token = Served(url, "", settings, log).key(*Right)
        yield Served(url, token, settings, log)
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE_S)


def _wait(process: "subprocess.Popen[bytes]", url: str, log: Path) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            pytest.fail(log.read_text())
        try:
            if httpx.get(f"{url}/health/ready", timeout=5).status_code == 200:
                return
        except httpx.TransportError:
            time.sleep(0.1)
    pytest.fail("the service did not get ready: " + log.read_text())
