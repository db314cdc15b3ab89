"""Ports for the services that tests start."""

import itertools
import os
import socket

# Below the ports that systems give to clients: one of those may be taken before the service has
# started. Workers of a test run begin apart.
_NUMBERS = itertools.count(64 * os.getpid())


def free_port() -> int:
    """A TCP port that nobody listens on, and that no other test of this process was given."""
    while True:
        port = 10_000 + next(_NUMBERS) % 20_000
        with socket.socket() as listener:
            try:
                listener.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
