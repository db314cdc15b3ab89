"""An application's own server: its page, the JavaScript client, and the service behind ``/v1/``."""

import functools
import gzip
import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx

from tests.clients.proxy import Proxy
from tests.patience import PATIENCE_S

PACKAGE = Path(__file__).resolve().parents[2] / "clients" / "javascript"
TYPES = {
    ".js": "text/javascript",
    ".mjs": "text/javascript",
    ".wasm": "application/wasm",
}
# As docs/javascript.md says that a page needs it, and no more.
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; connect-src 'self'; img-src data:; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
RUNTIME = (
    "ort.wasm.min.mjs",
    "ort-wasm-simd-threaded.mjs",
    "ort-wasm-simd-threaded.wasm",
)
KEPT = {"Cache-Control": "private, max-age=31536000, immutable"}
PAGE = """<!doctype html><html lang="en"><title>Log in</title>
<link rel="icon" href="data:,">
<input type="file" multiple><output></output><veilface-login></veilface-login>
<script type="module" src="/page.js"></script></html>"""
# Of a connection, and not of what goes over it.
_HOP = frozenset({"connection", "content-encoding", "content-length", "date", "server"})

Authorize = Callable[[Mapping[str, str]], dict[str, str]]


@dataclass
class Application:
    """Where it is, the program of its page, and every byte that browsers sent to it."""

    url: str
    recording: Proxy
    program: str = ""
    photos: dict[str, bytes] = field(default_factory=dict)


@contextmanager
def application(service: str, authorize: Authorize) -> Iterator[Application]:
    """Serve a page that logs in by the service at this URL, which gives it the graphs too.

    ``authorize`` makes the answer of ``POST /login/token`` of its body, a JSON object or nothing.
    """

    class Handler(BaseHTTPRequestHandler):
        # A browser asks again by an ETag only where it came by this version or a later one.
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None:
            pass

        def answer(
            self, data: bytes, kind: str, status: int = 200, headers: Mapping[str, str] = {}
        ) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Content-Security-Policy", POLICY)
            for name, value in headers.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        def do_GET(self) -> None:
            path = Path(self.path)
            if self.path == "/":
                self.answer(PAGE.encode(), "text/html; charset=utf-8")
            elif self.path == "/page.js":
                self.answer(served.program.encode(), TYPES[".js"])
            elif self.path.startswith(("/client/", "/ort/")):
                headers = {**KEPT, "Content-Encoding": "gzip"}
                self.answer(modules[self.path], TYPES[path.suffix], headers=headers)
            elif self.path.startswith("/photos/"):
                self.answer(served.photos[path.name], "image/jpeg")
            else:
                self.passed_on()

        def do_POST(self) -> None:
            if self.path == "/login/token":
                told = authorize(json.loads(self.body() or b"{}"))
                self.answer(json.dumps(told).encode(), "application/json")
            else:
                self.passed_on()

        do_PUT = do_POST

        def body(self) -> bytes:
            return self.rfile.read(int(self.headers.get("Content-Length", 0)))

        def passed_on(self) -> None:
            names = ("Authorization", "Content-Type", "If-None-Match")
            headers = {name: self.headers[name] for name in names if name in self.headers}
            response = upstream.request(
                self.command, self.path, content=self.body(), headers=headers
            )
            told = {
                name: value
                for name, value in response.headers.items()
                if name not in _HOP | {"content-type", "content-security-policy"}
            }
            kind = response.headers.get("Content-Type", "application/octet-stream")
            self.answer(response.content, kind, response.status_code, told)

    modules = _compressed_modules()
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        with (
            httpx.Client(base_url=service, timeout=PATIENCE_S) as upstream,
            Proxy(server.server_address[1]) as recording,
        ):
            served = Application(recording.url, recording)
            yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


@functools.cache
def _compressed_modules() -> dict[str, bytes]:
    """Client and runtime by their paths, compressed before somebody waits for them."""
    runtime = PACKAGE / "node_modules" / "onnxruntime-web" / "dist"
    files = {
        f"/client/{file.relative_to(PACKAGE / 'dist')}": file
        for file in (PACKAGE / "dist").rglob("*.js")
    } | {f"/ort/{name}": runtime / name for name in RUNTIME}
    return {path: gzip.compress(file.read_bytes()) for path, file in files.items()}


def for_browsers(program: str) -> str:
    """Name the modules by where they are served: a page has no packages."""
    return (
        program.replace('"onnxruntime-web"', '"/ort/ort.wasm.min.mjs"')
        .replace('"veilface-client/login"', '"/client/element/login.js"')
        .replace('"veilface-client"', '"/client/index.js"')
    )
