"""A TCP proxy that keeps every byte that a client sends, and can lose answers."""

import contextlib
import socket
import threading
from types import TracebackType
from typing import Self


class Proxy:
    """Listens on a port of its own, and passes everything on to a service.

    Attributes
    ----------
    lose
        So many of the next answers are lost: the service has given them, the client sees a closed
        connection.
    """

    def __init__(self, port: int) -> None:
        self._target = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listener.getsockname()[1]}"
        self.lose = 0
        self._connections: list[bytearray] = []
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._ups: list[threading.Thread] = []

    @property
    def sent(self) -> bytes:
        """Every byte that clients sent, connection after connection."""
        return b"\n".join(bytes(each) for each in list(self._connections))

    def taken(self) -> bytes:
        """Return :attr:`sent` and forget it, once every connection is over.

        A service may answer before it has the whole request, and so may a client go on.
        """
        for thread in self._ups:
            thread.join(timeout=10)
        assert not any(thread.is_alive() for thread in self._ups), "a client is still connected"
        sent = self.sent
        self.forget()
        return sent

    def forget(self) -> None:
        """Keep from now on only."""
        for each in self._connections:
            each.clear()

    def __enter__(self) -> Self:
        self._threads[0].start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        # A browser keeps connections open that it has no use for yet.
        _close(*self._sockets)
        for thread in self._threads:
            thread.join(timeout=10)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            kept = bytearray()
            self._connections.append(kept)
            service = socket.create_connection(("127.0.0.1", self._target))
            self._sockets += (client, service)
            up = threading.Thread(target=self._up, args=(client, service, kept), daemon=True)
            down = threading.Thread(target=self._down, args=(service, client), daemon=True)
            for pump in (up, down):
                pump.start()
                self._threads.append(pump)
            self._ups.append(up)

    def _up(self, client: socket.socket, service: socket.socket, kept: bytearray) -> None:
        with contextlib.suppress(OSError):
            while data := client.recv(65536):
                kept += data
                service.sendall(data)
        _close(client, service)

    def _down(self, service: socket.socket, client: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := service.recv(65536):
                if self.lose:
                    self.lose -= 1
                    break
                client.sendall(data)
        _close(client, service)


def _close(*sockets: socket.socket) -> None:
    for each in sockets:
        with contextlib.suppress(OSError):
            each.shutdown(socket.SHUT_RDWR)
        each.close()
