"""deploy/compose.yaml without images: its processes, started as the file and the Dockerfile say.

In a network namespace, where its services are known by their names, and with its files where it
mounts them. PostgreSQL and Redis are this machine's programs; `make image` runs the image itself,
as its user, on a read-only root and without capabilities.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml
from psycopg import sql

from tests.api.deployment import bearer, deploy, images, photo
from tests.pages import block_under
from tests.patience import PATIENCE_S, wait_until
from tests.reliability.cluster import Cluster, NoPostgres
from tests.reliability.hosts import Network

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parent.parent
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "deploy" / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
SECRETS = SERVICES["veilface"]["secrets"]
DOCKERFILE = (ROOT / "deploy" / "Dockerfile").read_text()
BIN = Path(sys.executable).parent
PREPARE = block_under("deploy.md", "A container", "sh")
POSTGRES_PORT = 5432

# A root like this machine's, but with what is mounted: SOURCE TARGET … -- PROGRAM ARGUMENT …
MOUNTED = """
set -e
root=$1
shift
mount -t tmpfs -o mode=0755 tmpfs "$root"
mkdir "$root/run"
for entry in /*; do
  if [ -L "$entry" ]; then cp -P "$entry" "$root"
  elif [ -d "$entry" ] && [ "$entry" != /run ]; then
    mkdir "$root$entry"
    mount --rbind "$entry" "$root$entry"
  fi
done
while [ "$1" != -- ]; do
  if [ -d "$1" ]; then mkdir "$root$2"
  elif [ ! -e "$root$2" ]; then mkdir -p "$(dirname "$root$2")"; touch "$root$2"
  fi
  mount --bind "$1" "$root$2"
  mount -o remount,bind,ro "$root$2"
  shift 2
done
shift
exec chroot "$root" "$@"
"""


def resolved(text: str, values: Mapping[str, str]) -> str:
    """Replace what Compose replaces: ``${NAME:-otherwise}`` and ``${NAME:?complaint}``."""

    def value(match: "re.Match[str]") -> str:
        name, kind, otherwise = match.groups()
        return values[name] if name in values or kind == "?" else otherwise

    return re.sub(r"\$\{(\w+):([-?])([^}]*)\}", value, text)


def words(pattern: str) -> list[str]:
    """A program of the Dockerfile, with its arguments."""
    (text,) = re.findall(rf"^{pattern} (\[.*\])$", DOCKERFILE, re.M)
    return list(json.loads(text))


class Composed:
    """The file's services; that of Veilface is started in the namespace, with its files."""

    def __init__(self, network: Network, folder: Path, values: Mapping[str, str]) -> None:
        service = SERVICES["veilface"]
        set_there = {name: resolved(text, values) for name, text in service["environment"].items()}
        of_image = dict(re.findall(r"\b(VEILFACE_\w+)=(\S+)", DOCKERFILE))
        self._environment = {**of_image, **set_there, "PATH": f"{BIN}:{os.environ['PATH']}"}
        self._within = network.within(0)
        hosts = folder / "hosts"
        hosts.write_text(f"127.0.0.1 localhost counters\n{network.address} database\n")
        volumes = [resolved(each, values) for each in service["volumes"] if each.endswith(":ro")]
        files = {name: resolved(COMPOSE["secrets"][name]["file"], values) for name in SECRETS}
        mounts = [
            f"{hosts}:/etc/hosts",
            *volumes,
            *(f"{files[name]}:/run/secrets/{name}" for name in service["secrets"]),
        ]
        root = folder / "root"
        root.mkdir()
        self._mounted = ["unshare", "--mount", "sh", "-c", MOUNTED, "sh", str(root)]
        self._mounted += [part for mount in mounts for part in mount.split(":")[:2]]
        self._mounted += ["--", "env", "--chdir=/data"]
        self.log = folder / "log"

    def start(self, *program: str) -> "subprocess.Popen[bytes]":
        """Start a program of Veilface's container; what it says goes into the log."""
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [*self._within, *self._mounted, *program],
                env=self._environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def start_counters(self) -> "subprocess.Popen[bytes]":
        command = [*self._within, *SERVICES["counters"]["command"]]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def counters(self, *arguments: str) -> str:
        """What Redis answers its own client."""
        command = [*self._within, "redis-cli", *arguments]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()


@contextmanager
def ended(process: "subprocess.Popen[bytes]") -> Iterator["subprocess.Popen[bytes]"]:
    try:
        yield process
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE_S)


@pytest.fixture
def network() -> Iterator[Network]:
    with Network(1) as made:
        yield made


@pytest.fixture
def database(network: Network) -> Iterator[Cluster]:
    """PostgreSQL as its image makes it: the password of the file is asked for, from the network."""
    environment = SERVICES["database"]["environment"]
    assert environment["POSTGRES_USER"] == environment["POSTGRES_DB"] == "veilface"
    try:
        made = Cluster(network.address, POSTGRES_PORT, "scram-sha-256")
    except NoPostgres as reason:
        pytest.skip(str(reason))
    with made:
        yield made


def prepare(folder: Path) -> dict[str, str]:
    """Run the page's preparation, but for root, whom the processes run as; what the file asks."""
    block = PREPARE.replace("10001:10001", "0:0").replace("-o 10001 -g 10001", "-o 0 -g 0")
    block = block.replace("/opt/veilface-deploy", str(folder / "deploy"))
    subprocess.run(["bash", "-euo", "pipefail", "-c", block], cwd=folder, check=True)
    return {
        "VEILFACE_DATA": str(folder / "deploy" / "data"),
        "VEILFACE_SECRETS": str(folder / "deploy" / "secrets"),
        "VEILFACE_PACK": str(folder / "tiny"),
    }


def test_the_services_of_the_file_work_together(
    network: Network, database: Cluster, tmp_path: Path
) -> None:
    if shutil.which("redis-server") is None:
        pytest.skip("there is no redis-server")
    deploy(tmp_path, data_dir=tmp_path / "veilface-data")
    values = prepare(tmp_path)
    composed = Composed(network, tmp_path, values)
    password = (tmp_path / "deploy" / "secrets" / "database.password").read_text()
    with database.connect() as connection:
        connection.execute(sql.SQL("ALTER ROLE veilface PASSWORD {}").format(password))
    with ExitStack() as running:
        running.enter_context(ended(composed.start_counters()))
        wait_until(lambda: composed.counters("ping") == "PONG")
        service = running.enter_context(ended(composed.start(*words("ENTRYPOINT"), *words("CMD"))))

        def is_healthy() -> bool:
            assert service.poll() is None, composed.log.read_text()
            return composed.start(*words(r"    CMD")).wait() == 0

        wait_until(is_healthy, every_s=1)
        rights = ["--right", "enroll", "--right", "verify"]
        made = composed.start(*words("ENTRYPOINT"), "keys", "create", *rights)
        assert made.wait(timeout=PATIENCE_S) == 0, composed.log.read_text()
        (token,) = set(re.findall(r"vf_\w+", composed.log.read_text()))
        url = f"http://{network.address_of(0)}:8421"
        with httpx.Client(
            base_url=url, headers=bearer(token), timeout=PATIENCE_S, trust_env=False
        ) as client:
            enrolled = client.put("/v1/subjects/ann/enrollment", files=images(photo(1)))
            assert enrolled.status_code == 201, enrolled.text
            for person, decision in ((1, "accept"), (2, "reject")):
                shown = images(photo(person, 1), name="image")
                answer = client.post("/v1/subjects/ann/verify", files=shown)
                assert answer.json()["decision"] == decision
        assert int(composed.counters("dbsize")) > 0
        assert composed.log.read_text().count('"event": "started"') == 2
    with database.connect() as connection:
        rows = connection.execute("SELECT subject_id FROM subjects").fetchall()
    assert rows == [("ann",)]
