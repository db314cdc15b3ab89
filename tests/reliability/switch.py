"""A TCP switch before the services of an upgrade: what a proxy does with new connections."""

import contextlib
import socket
import socketserver
import threading
from collections import Counter
from collections.abc import Iterator


class Switch(socketserver.ThreadingTCPServer):
    """Leads each new connection to the port that is named now; listens during the block.

    Attributes
    ----------
    target
        Port on this machine; may be changed at any time.
    """

    daemon_threads = True
    request_queue_size = 128

    def __init__(self, target: int) -> None:
        super().__init__(("127.0.0.1", 0), _Connection)
        self.target = target
        self.url = f"http://127.0.0.1:{self.server_address[1]}"
        self._lock = threading.Lock()
        self._open: Counter[int] = Counter()

    def __enter__(self) -> "Switch":
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

    @contextlib.contextmanager
    def leading(self) -> Iterator[int]:
        """Choose the target of a connection, which is open until the end of the block."""
        with self._lock:
            target = self.target
            self._open[target] += 1
        try:
            yield target
        finally:
            with self._lock:
                self._open[target] -= 1

    def has_left(self, port: int) -> bool:
        """Whether no connection leads to a port, nor will one."""
        with self._lock:
            return self.target != port and not self._open[port]


class _Connection(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        assert isinstance(self.server, Switch)
        with (
            self.server.leading() as target,
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", target)) as there,
        ):
            back = threading.Thread(target=_pass_on, args=(there, self.request), daemon=True)
            back.start()
            _pass_on(self.request, there)
            back.join()


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(1 << 16):
            sink.sendall(data)
    with contextlib.suppress(OSError):
        sink.shutdown(socket.SHUT_WR)
