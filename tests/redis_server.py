"""A Redis server of a test's own, which can be killed."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import pytest
import redis

from tests.patience import wait_until
from tests.ports import free_port


class OwnRedis:
    """It answers at one address and keeps no file."""

    def __init__(self, address: str = "127.0.0.1") -> None:
        self.port = free_port()
        self._address = address
        self.url = f"redis://{address}:{self.port}/0"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        self.process = subprocess.Popen(
            [
                *("redis-server", "--bind", self._address, "--port", str(self.port)),
                *("--protected-mode", "no", "--save", "", "--dir", "/"),
            ],
            user="nobody" if os.geteuid() == 0 else None,
            stdout=subprocess.DEVNULL,
        )
        with redis.Redis.from_url(self.url) as client:

            def answers() -> bool:
                with suppress(redis.RedisError):
                    return bool(client.ping())
                return False

            wait_until(answers, what="the Redis server")

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


@contextmanager
def own_redis_server(address: str = "127.0.0.1") -> Iterator[OwnRedis]:
    """Give a server that is not started yet, and kill it after the block."""
    if shutil.which("redis-server") is None:
        pytest.skip("there is no redis-server to start and kill")
    server = OwnRedis(address)
    try:
        yield server
    finally:
        server.kill()
