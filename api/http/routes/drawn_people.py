"""The drawn people of the demo, for the page to try the service with; in the demo only."""

import functools
import re

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import BaseRoute

from api.http.answers import answer
from api.http.errors import ApiError
from api.http.routes.page import HEADERS, route_of
from api.limits.rates import address_of
from models.synthetic import draw_face, encode_photo

ENROLLED = range(1, 9)
"""Whom `veilface demo` enrolls first, by the numbers that their faces are drawn from."""
STRANGERS = range(101, 107)
ENROLLED_PHOTOS = 3
PROBE_PHOTOS = 2
SHOTS = ENROLLED_PHOTOS + PROBE_PHOTOS
_PERSON = re.compile(r"person-([1-9][0-9]{0,3})")
_SHOT = re.compile(r"(0|[1-9])\.png")


def drawn_people_routes() -> list[BaseRoute]:
    """Return the routes of the drawn people."""
    return [
        route_of("/demo/people", list_people),
        route_of("/demo/people/{person}/{shot}", draw_photo),
    ]


async def list_people(request: Request) -> Response:
    """List them, those who are enrolled first."""
    names = [f"person-{number}" for number in (*ENROLLED, *STRANGERS)]
    return answer(request, {"people": names, "shots": SHOTS})


async def draw_photo(request: Request) -> Response:
    """Draw one photo of one of them; the same path gives the same bytes."""
    person = _PERSON.fullmatch(request.path_params["person"])
    shot = _SHOT.fullmatch(request.path_params["shot"])
    if person is None or shot is None or int(shot[1]) >= SHOTS:
        raise _no_such_photo()
    number = int(person[1])
    if number not in ENROLLED and number not in STRANGERS:
        raise _no_such_photo()
    gate = request.app.state.gate
    address = address_of(request.client.host if request.client else "")
    body = await gate.compute(functools.partial(_drawn, number, int(shot[1])), key=address)
    return Response(
        body,
        media_type="image/png",
        headers={**HEADERS, "Cache-Control": "private, max-age=3600"},
    )


def _no_such_photo() -> ApiError:
    return ApiError("not_found", "there is no such cartoon person or photo")


@functools.cache
def _drawn(person: int, shot: int) -> bytes:
    # Fewer than a hundred pictures of 20 KB: all of them may stay.
    return encode_photo(draw_face(person, shot))
