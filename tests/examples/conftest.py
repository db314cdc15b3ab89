"""A real service with the demo model, on which the examples run."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests.api.cli.conftest import World, copied, run, world
from tests.clients.conftest import VEILFACE
from tests.patience import PATIENCE_S
from tests.ports import free_port
from veilface_client import Client

__all__ = ["world"]

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ENROLLED = 3


@dataclass(frozen=True)
class Service:
    """Where it is, two of its keys, and photos of people who do not exist; `ann` is person 1."""

    url: str
    token: str
    verifying: str
    world: World

    def photo(self, person: int, number: int) -> bytes:
        (path,) = self.world.photos(person, range(number, number + 1))
        return path.read_bytes()


def clean_environment(**added: str) -> dict[str, str]:
    ours = {name: value for name, value in os.environ.items() if not name.startswith("VEILFACE_")}
    return ours | {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"} | added


@contextmanager
def running(arguments: list[str], url: str, env: dict[str, str], log: Path) -> Iterator[str]:
    """Run a server until the block ends; it is up once it answers anything."""
    with log.open("wb") as sink:
        process = subprocess.Popen(arguments, env=env, stdout=sink, stderr=sink)
        try:
            end = time.monotonic() + PATIENCE_S
            while time.monotonic() < end:
                assert process.poll() is None, log.read_text()
                try:
                    httpx.get(url, timeout=5)
                    break
                except httpx.TransportError:
                    time.sleep(0.1)
            yield url
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE_S)


@pytest.fixture(scope="package")
def service(world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("examples")
    data = copied(world.data, folder)
    photos = [str(photo) for photo in world.photos(1, range(ENROLLED))]
    enrolled = run("enroll", "ann", *photos, "--pack", world.pack, "--data-dir", data)
    assert enrolled.status == 0, enrolled.stderr
    made = [
        run("keys", "create", *rights, "--data-dir", data).stdout.split()[-1]
        for rights in (("--right", "verify"), ("--right", "verify", "--right", "enroll",
                       "--right", "erase", "--right", "admin"))
    ]  # fmt: skip
    port = free_port()
    env = clean_environment(
        VEILFACE_PACK=str(world.pack),
        VEILFACE_DATA_DIR=str(data),
        VEILFACE_PORT=str(port),
    )
    url = f"http://127.0.0.1:{port}"
    serve = [str(VEILFACE), "serve"]
    with running(serve, url + "/health/ready", env, folder / "serve.log"):
        with Client(url, made[0]) as client:
            client.verify("ann", photos[0])
        yield Service(url, made[1], made[0], world)


def node() -> str:
    """The program ``node``, of at least version 18."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("Node is not installed")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True)
    if int(version.stdout.strip().lstrip("v").split(".")[0]) < 18:
        pytest.skip(f"Node {version.stdout.strip()} is older than 18")
    return found


PYTHON = sys.executable
