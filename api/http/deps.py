"""Parameters that several routes take, as annotated aliases, and what none of them takes."""

import re
from typing import Annotated
from urllib.parse import parse_qsl

from fastapi import Depends, Header, Path, Query, Request
from pydantic import BeforeValidator

from api.http.auth import AnyCall
from api.http.errors import ApiError, refuse_unknown_names
from templates.store.identifiers import SUBJECT_ID_RULE, checked_subject_id
from templates.store.subjects import Precondition


async def subject_of(
    call: AnyCall,
    subject_id: Annotated[
        str, Path(description=f"Subject id: has {SUBJECT_ID_RULE}.", examples=["alice"])
    ],
) -> str:
    """Return the subject id in NFC, and note its pseudonym for the logs."""
    subject_id = checked_subject_id(subject_id)
    call.note_subject(subject_id)
    return subject_id


async def refuse_unknown(request: Request) -> None:
    """Refuse a query or a body that the route does not read.

    Every route depends on it. One that is not FastAPI's, as of the page, reads no parameter.
    """
    dependant = getattr(request.scope["route"], "dependant", None)
    known = [] if dependant is None else [field.alias for field in dependant.query_params]
    query = request.scope["query_string"]
    try:
        pairs = parse_qsl(
            query.decode("ascii"),
            keep_blank_values=True,
            strict_parsing=bool(query),
            errors="strict",
        )
    except ValueError:
        raise ApiError("validation_failed", "the query is not name=value pairs in UTF-8") from None
    names = [name for name, _ in pairs]
    refuse_unknown_names(names, known, "query parameter")
    if len(set(names)) < len(names):
        raise ApiError("validation_failed", "a query parameter comes twice")
    await refuse_body(request)


async def refuse_body(request: Request) -> None:
    """Refuse a body where the call takes none."""
    headers = request.headers
    sent = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
    if sent and request.method in ("GET", "HEAD", "DELETE"):
        raise ApiError("validation_failed", "this call takes no body: send it without one")


_ETAG = re.compile(r'"([A-Za-z0-9_-]{1,64})"')


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
    """Return what the subject must have for a write; None where the request does not say."""
    sent = request.headers.getlist("If-None-Match") + request.headers.getlist("If-Match")
    if not sent:
        return None
    if len(sent) == 1 and if_none_match is not None and if_none_match.strip() == "*":
        return Precondition(None)
    named = _ETAG.fullmatch((if_match or "").strip())
    if len(sent) > 1 or named is None:
        raise _precondition_refused(
            "send one of the two, once: If-None-Match: * never replaces an enrollment, "
            'If-Match: "…" replaces the one with this ETag'
        )
    return Precondition(named[1])


async def refuse_precondition(request: Request) -> None:
    """Refuse the two headers where nothing heeds them: the write would happen regardless."""
    if "If-None-Match" in request.headers or "If-Match" in request.headers:
        raise _precondition_refused("this call takes neither: send it without them")


def _precondition_refused(message: str) -> ApiError:
    field = "If-Match, If-None-Match"
    return ApiError("validation_failed", f"{field}: {message}", {"field": field})


def has_copy(request: Request, etag: str) -> bool:
    """Whether `If-None-Match` says that the client has what this `ETag` names."""
    tags = request.headers.get("if-none-match", "").split(",")
    return bool({tag.strip().removeprefix("W/") for tag in tags} & {etag, "*"})


def etag(template_id: str) -> str:
    """Return the entity tag of an enrollment."""
    return f'"{template_id}"'


def _digits(value: str | int) -> str | int:
    if isinstance(value, str) and not (value.isascii() and value.isdigit()):
        raise ValueError("has a wrong value: it must be a whole number")
    return value


Limit = Annotated[
    int, BeforeValidator(_digits), Query(ge=1, le=1000, description="Entries on one page, at most.")
]
Cursor = Annotated[str | None, Query(description="`next_cursor` of the page before.")]
SubjectDep = Annotated[str, Depends(subject_of)]
PreconditionDep = Annotated[Precondition | None, Depends(precondition_of)]
NoPreconditionDep = Annotated[None, Depends(refuse_precondition)]
