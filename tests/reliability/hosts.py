"""Hosts of one deployment, as network namespaces of this machine behind a bridge.

PostgreSQL and Redis answer at the bridge's address, and the tests' own requests come from there.
"""

import ctypes
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
from tests.api.server_process import ROOT, Server
from tests.ports import free_port
from tests.redis_server import own_redis_server
from tests.reliability.cluster import Cluster
from tests.reliability.kill import QUIET
from tests.required import absent

ROOT_REQUIRED = "VEILFACE_REQUIRE_ROOT"
BRIDGE = "bridge"
PREFIX = "198.18.0"
"""Of its addresses: for measurements between networks (RFC 2544)."""


class Network:
    """A bridge, with a namespace and a link for each host; gone at the end of the block.

    The bridge has a namespace too, and the calling thread is in it during the block, with what it
    starts: a browser of another test gives up what it is loading whenever the machine's own network
    changes. Where this machine does not permit them, the test is skipped.
    """

    address = f"{PREFIX}.1"

    def __init__(self, hosts: int) -> None:
        if os.geteuid() != 0 or shutil.which("ip") is None:
            absent("network namespaces need root, and the program ip", ROOT_REQUIRED)
        self._name = f"veilface{os.getpid()}"
        self._hosts = range(hosts)
        self._left = ExitStack()

    def __enter__(self) -> "Network":
        with ExitStack() as entered:
            try:
                self._enter_namespace(entered)
                _ip("link", "add", BRIDGE, "type", "bridge")
                _ip("address", "add", f"{self.address}/24", "dev", BRIDGE)
                for device in ("lo", BRIDGE):
                    _ip("link", "set", device, "up")
                for host in self._hosts:
                    self._add(host, entered)
            except subprocess.CalledProcessError as error:
                absent(f"no network namespaces: {error.stderr.strip()}", ROOT_REQUIRED)
            except PermissionError as error:
                absent(f"no network namespaces: {error}", ROOT_REQUIRED)
            self._left = entered.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._left.close()

    def address_of(self, host: int) -> str:
        return f"{PREFIX}.{host + 2}"

    def within(self, host: int) -> list[str]:
        """What runs a program on a host."""
        return ["ip", "netns", "exec", self._name_of(host)]

    def cut_off(self, host: int) -> None:
        """Let nothing reach a host or leave it, without a word to either side."""
        _ip("link", "set", f"host{host}", "down")

    def reconnect(self, host: int) -> None:
        _ip("link", "set", f"host{host}", "up")

    def _name_of(self, host: int) -> str:
        return f"{self._name}-{host}"

    def _enter_namespace(self, entered: ExitStack) -> None:
        _add_namespace(self._name, entered)
        before = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        entered.callback(os.close, before)
        inside = os.open(f"/run/netns/{self._name}", os.O_RDONLY)
        try:
            _enter(inside)
        finally:
            os.close(inside)
        entered.callback(_enter, before)

    def _add(self, host: int, entered: ExitStack) -> None:
        name, device = self._name_of(host), f"host{host}"
        _add_namespace(name, entered)
        _ip("link", "add", device, "type", "veth", "peer", "name", "eth0", "netns", name)
        _ip("link", "set", device, "master", BRIDGE, "up")
        _ip("-n", name, "address", "add", f"{self.address_of(host)}/24", "dev", "eth0")
        for each in ("lo", "eth0"):
            _ip("-n", name, "link", "set", each, "up")


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


def _add_namespace(name: str, entered: ExitStack) -> None:
    _ip("netns", "add", name)
    entered.callback(_ip, "netns", "delete", name)


def _enter(namespace: int) -> None:
    """Move the calling thread into a namespace (``os.setns`` from Python 3.12 on)."""
    if ctypes.CDLL(None, use_errno=True).setns(namespace, 0):
        raise OSError(ctypes.get_errno(), "setns")  # a PermissionError where it is one


class Host:
    """A host with its service."""

    def __init__(self, number: int, network: Network, shared: Deployment, folder: Path) -> None:
        self._number = number
        self._network = network
        self.address = network.address_of(number)
        settings = shared.settings.model_copy(update={"host": self.address})
        deployment = replace(shared, settings=settings)
        self.service = Server(deployment, folder, within=network.within(number))

    def cut_off(self) -> None:
        self._network.cut_off(self._number)

    def reconnect(self) -> None:
        self._network.reconnect(self._number)

    def thinks_it_is_ready(self) -> bool:
        """Whether its health check passes on the host itself, which may be cut off."""
        asked = subprocess.run(
            [*self.service.within, sys.executable, "-m", "veilface.healthcheck"],
            cwd=ROOT,
            env=self.service.environment,
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
