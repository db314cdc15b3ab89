"""The web page: its files, from memory.

Not part of the REST contract, so not in its document. The page works by the calls that are in it,
and anybody with a key may do the same without the page. Its files name each other and the calls by
relative URLs, so that a proxy may show the service under any path.
"""

import hashlib
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute, Route

from api.http.deps import has_copy, refuse_body, refuse_unknown

WEB = Path(__file__).resolve().parents[2] / "web"
CLIENT = WEB / "client"
"""The JavaScript client and ONNX Runtime, compressed; there after `make javascript`."""
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".mjs": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".wasm": "application/wasm",
}
HEADERS = {
    # Asked for again each time, and answered 304 while it is the same: after an update of the
    # service no browser runs yesterday's script against today's calls.
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'; require-trusted-types-for 'script'; trusted-types 'none'",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=(), display-capture=()",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
WITH_GRAPHS = {
    **HEADERS,
    # In private mode the page runs the graphs, and a runtime of theirs is WebAssembly.
    "Content-Security-Policy": HEADERS["Content-Security-Policy"].replace(
        "script-src 'self'", "script-src 'self' 'wasm-unsafe-eval'"
    ),
}

Endpoint = Callable[[Request], Awaitable[Response]]
Check = Callable[[Request], Awaitable[None]]


@dataclass(frozen=True)
class Served:
    """One file, from memory."""

    body: bytes = field(repr=False)
    suffix: str
    headers: Mapping[str, str] = field(default_factory=lambda: HEADERS)

    async def answer(self, request: Request) -> Response:
        """Return the file, or that the browser's copy is still the same."""
        headers = {**self.headers, "ETag": f'"{hashlib.sha256(self.body).hexdigest()[:32]}"'}
        if has_copy(request, headers["ETag"]):
            return Response(status_code=304, headers=headers)
        return Response(self.body, media_type=TYPES[self.suffix], headers=headers)


def page_routes(*, demo: bool, serve_pack: bool) -> list[BaseRoute]:
    """Return the routes of the page."""
    # Not in the demo, whose model knows a cartoon face by a check that no graph holds.
    lifts = serve_pack and not demo
    client = sorted(CLIENT.glob("*.gz" if lifts else "client.js.gz"))
    html = (WEB / "index.html").read_text(encoding="utf-8")
    for name, holds in (("demo", demo), ("client", bool(client)), ("private", lifts)):
        html = html.replace(f'data-{name}="no"', f'data-{name}="{"yes" if holds else "no"}"')
    headers = WITH_GRAPHS if client and lifts else HEADERS
    assets = {
        path.name: Served(path.read_bytes(), path.suffix, headers)
        for path in sorted(WEB.iterdir())
        if path.suffix in TYPES and path.name != "index.html"
    }
    for path in client:
        zipped = {**headers, "Content-Encoding": "gzip"}
        suffix = Path(path.stem).suffix
        assets[f"{CLIENT.name}/{path.stem}"] = Served(path.read_bytes(), suffix, zipped)
    index = Served(html.encode(), ".html", headers)
    # A person follows a link to the page, to which mail and search programs add parameters.
    return [
        route_of("/", index.answer, check=refuse_body),
        *(route_of(f"/assets/{name}", file.answer) for name, file in assets.items()),
    ]


def route_of(path: str, endpoint: Endpoint, *, check: Check = refuse_unknown) -> Route:
    """Route a path that is not in the document of the API, after a check of each request."""

    async def named(request: Request) -> Response:
        # What log lines and metrics call it, as FastAPI does for its own routes.
        request.scope["route"] = route
        await check(request)
        return await endpoint(request)

    route = Route(path, named, methods=["GET"])
    return route
