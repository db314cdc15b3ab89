"""The OpenAPI document, and its reference at `/docs`: Swagger UI, by files that a package brings.

All are served from memory, and name each other by relative URLs and no other host. A key that is
entered there is kept by the page until it is closed.
"""

import json
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

from starlette.routing import BaseRoute

from api.http.routes.page import HEADERS, Served, route_of

PAGE = """<!doctype html><html lang="en"><head><meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>Veilface API</title>
<link rel="stylesheet" href="docs/swagger-ui.css"></head><body><main id="reference"></main>
<script src="docs/swagger-ui-bundle.js"></script><script src="docs/start.js"></script>
</body></html>
"""
START = """SwaggerUIBundle({
  url: "v1/openapi.json", dom_id: "#reference", deepLinking: true, validatorUrl: null,
});
"""
POLICY = {
    **HEADERS,
    # Swagger UI writes styles into its elements, and its style sheet has pictures in it.
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; "
    "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
}


def reference_routes() -> list[BaseRoute]:
    """Return the routes of the reference."""
    brought = files("fastapi_offline") / "static"
    contents = {"/docs": (PAGE.encode(), ".html"), "/docs/start.js": (START.encode(), ".js")}
    for name, suffix in (("swagger-ui-bundle.js", ".js"), ("swagger-ui.css", ".css")):
        contents[f"/docs/{name}"] = (brought.joinpath(name).read_bytes(), suffix)
    return [route_of(path, Served(*content, POLICY).answer) for path, content in contents.items()]


def document_routes(document: Mapping[str, Any], *, root_path: str) -> list[BaseRoute]:
    """Return the route of the OpenAPI document; under a path of a proxy, it names that path."""
    if root_path:
        document = {"servers": [{"url": root_path}], **document}
    text = json.dumps(document, separators=(",", ":")).encode()
    file = Served(text, ".json", {"Cache-Control": "no-cache"})
    return [route_of("/v1/openapi.json", file.answer)]
