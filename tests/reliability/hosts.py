"""Hosts of one deployment, as network namespaces of this machine behind a bridge.

PostgreSQL and Redis answer at the bridge's address, and the tests' own requests come from there.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from tests.api.deployment import Deployment, deploy
from tests.ports import free_port
from tests.privileges import not_permitted
from tests.redis_server import own_redis_server
from tests.reliability.cluster import Cluster
from tests.reliability.kill import QUIET
from tests.reliability.service import ROOT, Service


class Network:
    """A bridge, with a namespace and a link for each host; gone at the end of the block.

    Where this machine does not permit them, the test is skipped.
    """

    def __init__(self, hosts: int) -> None:
        if os.geteuid() != 0 or shutil.which("ip") is None:
            not_permitted("network namespaces need root, and the program ip")
        number = os.getpid()
        # For measurements between networks (RFC 2544): nobody's network has them.
        self._prefix = f"198.18.{number % 256}"
        self._bridge = f"vf{number}"
        self._hosts = range(hosts)
        self.address = f"{self._prefix}.1"

    def __enter__(self) -> "Network":
        try:
            self._ip("link", "add", self._bridge, "type", "bridge")
            self._ip("address", "add", f"{self.address}/24", "dev", self._bridge)
            self._ip("link", "set", self._bridge, "up")
            for host in self._hosts:
                self._add(host)
        except BaseException as error:
            self.__exit__()
            if isinstance(error, subprocess.CalledProcessError):
                not_permitted(f"no network namespaces: {error.stderr.strip()}")
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for host in self._hosts:
            self._ip("netns", "delete", self._name(host), check=False)
        self._ip("link", "delete", self._bridge, check=False)

    def address_of(self, host: int) -> str:
        return f"{self._prefix}.{host + 2}"

    def within(self, host: int) -> list[str]:
        """What runs a program on a host."""
        return ["ip", "netns", "exec", self._name(host)]

    def cut_off(self, host: int) -> None:
        """Let nothing reach a host or leave it, without a word to either side."""
        self._ip("link", "set", self._name(host), "down")

    def reconnect(self, host: int) -> None:
        self._ip("link", "set", self._name(host), "up")

    def _name(self, host: int) -> str:
        return f"{self._bridge}h{host}"

    def _add(self, host: int) -> None:
        name = self._name(host)
        self._ip("netns", "add", name)
        self._ip("link", "add", name, "type", "veth", "peer", "name", "eth0", "netns", name)
        self._ip("link", "set", name, "master", self._bridge, "up")
        self._ip("-n", name, "address", "add", f"{self.address_of(host)}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            self._ip("-n", name, "link", "set", device, "up")

    def _ip(self, *arguments: str, check: bool = True) -> None:
        subprocess.run(["ip", *arguments], check=check, capture_output=True, text=True)


class Host:
    """A host with its service."""

    def __init__(self, number: int, network: Network, shared: Deployment, folder: Path) -> None:
        self._number = number
        self._network = network
        self.address = network.address_of(number)
        settings = shared.settings.model_copy(update={"host": self.address})
        deployment = replace(shared, settings=settings)
        self.service = Service(deployment, folder, within=network.within(number))

    def cut_off(self) -> None:
        self._network.cut_off(self._number)

    def reconnect(self) -> None:
        self._network.reconnect(self._number)

    def thinks_it_is_ready(self) -> bool:
        """Whether its health check passes on the host itself, which may be cut off."""
        asked = subprocess.run(
            [*self.service.within, sys.executable, "-m", "api.process.healthcheck"],
            cwd=ROOT,
            env=self.service.environment(),
            stderr=subprocess.DEVNULL,
        )
        return asked.returncode == 0


@contextmanager
def two_hosts(
    network: Network, cluster: Cluster, folder: Path, **changes: Any
) -> Iterator[tuple[Host, Host]]:
    """Two hosts with their services, on one database and one Redis."""
    # A session ends because its host was cut off, or not at all.
    url = f"{cluster.url}?options=-c%20idle_in_transaction_session_timeout%3D0"
    with ExitStack() as running:
        counters = running.enter_context(own_redis_server(network.address))
        counters.start()
        changes = {**QUIET, "rate_limit_storage": counters.url, **changes}
        shared = deploy(folder, database_url=url, port=free_port(), **changes)
        first, second = (Host(number, network, shared, folder) for number in range(2))
        for host in (first, second):
            running.enter_context(host.service)
        yield first, second
