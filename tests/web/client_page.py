"""An application's own server: its page, the JavaScript client, and the service behind ``/v1/``."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx

from models.pack import ModelPack
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
PAGE = """<!doctype html><html lang="en"><title>Log in</title>
<link rel="icon" href="data:,">
<input type="file" multiple><output></output><veilface-login></veilface-login>
<script type="module" src="/page.js"></script></html>"""


@dataclass
class Application:
    """Where it is, the program of its page, and what browsers sent to the service through it."""

    url: str
    program: str = ""
    photos: dict[str, bytes] = field(default_factory=dict)
    sent: list[bytes] = field(default_factory=list)


@contextmanager
def application(
    service: str, folder: Path, pack: ModelPack, authorize: Callable[[], dict[str, str]]
) -> Iterator[Application]:
    """Serve a page that logs in by the service at this URL; the graphs are hosted here.

    The list of graphs is as ``GET /v1/pack`` has it.
    """
    assert pack.info.detector is not None
    graphs = {
        pack.info.detector.sha256: ("detector", folder / pack.info.detector.file),
        pack.info.embedder_sha256: ("embedder", folder / pack.info.embedder_file),
    }

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def answer(self, data: bytes, kind: str, status: int = 200) -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Content-Security-Policy", POLICY)
            self.end_headers()
            self.wfile.write(data)

        def json(self, value: object) -> None:
            self.answer(json.dumps(value).encode(), "application/json")

        def do_GET(self) -> None:
            path = Path(self.path)
            if self.path == "/":
                self.answer(PAGE.encode(), "text/html; charset=utf-8")
            elif self.path == "/page.js":
                self.answer(served.program.encode(), TYPES[".js"])
            elif self.path.startswith(("/client/", "/ort/")):
                root = PACKAGE / "dist"
                if self.path.startswith("/ort/"):
                    root = PACKAGE / "node_modules" / "onnxruntime-web" / "dist"
                self.answer((root / Path(*path.parts[2:])).read_bytes(), TYPES[path.suffix])
            elif self.path.startswith("/photos/"):
                self.answer(served.photos[path.name], "image/jpeg")
            elif self.path == "/v1/pack":
                files = [{"role": role, "sha256": name} for name, (role, _) in graphs.items()]
                self.json({"name": "test", "licence": None, "files": files, "request_id": "-"})
            elif self.path.startswith("/v1/pack/"):
                self.answer(graphs[path.name][1].read_bytes(), "application/octet-stream")
            else:
                self.passed_on()

        def do_POST(self) -> None:
            if self.path == "/login/token":
                self.json(authorize())
            else:
                self.passed_on()

        do_PUT = do_POST

        def passed_on(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            served.sent.append(body)
            names = ("Authorization", "Content-Type", "Idempotency-Key")
            headers = {name: self.headers[name] for name in names if name in self.headers}
            response = httpx.request(
                self.command, service + self.path, content=body, headers=headers, timeout=PATIENCE_S
            )
            self.answer(response.content, response.headers["Content-Type"], response.status_code)

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    served = Application(f"http://127.0.0.1:{server.server_address[1]}")
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield served
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def for_browsers(program: str) -> str:
    """Name the modules by where they are served: a page has no packages."""
    return (
        program.replace('"onnxruntime-web"', '"/ort/ort.wasm.min.mjs"')
        .replace('"veilface-client/login"', '"/client/element/login.js"')
        .replace('"veilface-client"', '"/client/index.js"')
    )
