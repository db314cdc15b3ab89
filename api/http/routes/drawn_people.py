"""The drawn people of the demo, for the page to try the service with; in the demo only."""

import functools

from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute

from api.http.errors import ApiError
from api.http.routes.page import HEADERS, route_of
from api.limits.rates import address_of
from models.synthetic import draw_face, encode_photo

ENROLLED = range(1, 9)
"""Whom `veilface demo` enrolls first, by the numbers that their faces are drawn from."""
STRANGERS = range(101, 107)
ENROLLED_PHOTOS = 3
SHOTS = ENROLLED_PHOTOS + 2
_PEOPLE = {f"person-{number}": number for number in (*ENROLLED, *STRANGERS)}
_FILES = {f"{shot}.png": shot for shot in range(SHOTS)}


def drawn_people_routes() -> list[BaseRoute]:
    """Return the routes of the drawn people."""
    return [
        route_of("/demo/people", list_people),
        route_of("/demo/people/{person}/{shot}", draw_photo),
    ]


async def list_people(_: Request) -> Response:
    """List them, those who are enrolled first."""
    return JSONResponse({"people": list(_PEOPLE), "shots": SHOTS})


async def draw_photo(request: Request) -> Response:
    """Draw one photo of one of them; the same path gives the same bytes."""
    person = _PEOPLE.get(request.path_params["person"])
    shot = _FILES.get(request.path_params["shot"])
    if person is None or shot is None:
        raise ApiError("not_found", "there is no such cartoon person or photo")
    address = address_of(request.client.host if request.client else "")
    work = functools.partial(_drawn, person, shot)
    body = await request.app.state.gate.compute(work, key=address)
    headers = {**HEADERS, "Cache-Control": "private, max-age=3600"}
    return Response(body, media_type="image/png", headers=headers)


@functools.cache
def _drawn(person: int, shot: int) -> bytes:
    # Fewer than a hundred pictures of 20 KB: all of them may stay.
    return encode_photo(draw_face(person, shot))
