"""What a write may replace, as a request says it: ``If-None-Match`` and ``If-Match``."""

import re
from typing import Annotated

from fastapi import Depends, Header, Request

from api.http.errors import ApiError
from templates.store.subjects import Precondition

_ETAG = re.compile(r'"([A-Za-z0-9_-]{1,64})"')


def etag(template_id: str) -> str:
    """Return the entity tag of an enrollment."""
    return f'"{template_id}"'


async def precondition_of(
    request: Request,
    if_none_match: Annotated[
        str | None, Header(description="`*`: never replace an enrollment.", examples=["*"])
    ] = None,
    if_match: Annotated[
        str | None,
        Header(
            description="The `ETag` of an enrollment, which is its template id in quotation marks: "
            "replace this enrollment only.",
            examples=['"6f1d3c5f0d9b4a7f8e2b1a0c9d8e7f60"'],
        ),
    ] = None,
) -> Precondition | None:
    """Return what the subject must have; None where the request does not say.

    Raises
    ------
    ApiError
        ``validation_failed`` for any other use of the two headers.
    """
    names = [name for name in ("If-None-Match", "If-Match") if name in request.headers]
    if not names:
        return None
    if len(names) > 1 or len(request.headers.getlist(names[0])) > 1:
        raise _refused("send If-None-Match or If-Match, once")
    if if_none_match is not None:
        if if_none_match.strip() != "*":
            raise _refused("If-None-Match must be *, which never replaces an enrollment")
        return Precondition(None)
    named = _ETAG.fullmatch((if_match or "").strip())
    if named is None:
        raise _refused(
            'If-Match must be one template id in quotation marks, as the header ETag has it: "…"'
        )
    return Precondition(named[1])


async def refuse_precondition(request: Request) -> None:
    """Refuse the two headers where nothing heeds them: the write would happen regardless.

    Raises
    ------
    ApiError
        ``validation_failed``.
    """
    if "If-None-Match" in request.headers or "If-Match" in request.headers:
        raise _refused("this call takes neither If-Match nor If-None-Match: send it without them")


NoPreconditionDep = Annotated[None, Depends(refuse_precondition)]
PreconditionDep = Annotated[Precondition | None, Depends(precondition_of)]


def _refused(message: str) -> ApiError:
    return ApiError("validation_failed", message, {"field": "If-Match, If-None-Match"})
