"""The API reference at `/docs`: a page and its style sheet, from memory."""

import functools
from pathlib import Path

from fastapi import FastAPI
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute

from api.http.reference import render
from api.http.routes.page import Served, route_of

STYLE = Path(__file__).resolve().parents[1] / "reference.css"


def reference_routes(app: FastAPI) -> list[BaseRoute]:
    """Return the routes of the reference of an application."""
    sheet = Served.of(STYLE.read_bytes(), ".css")

    @functools.cache
    def rendered() -> Served:
        return Served.of(render(app.openapi()).encode(), ".html")

    async def page(request: Request) -> Response:
        return rendered().answer(request)

    async def style(request: Request) -> Response:
        return sheet.answer(request)

    return [route_of("/docs", page), route_of("/docs/reference.css", style)]
