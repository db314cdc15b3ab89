"""Dependencies of the routes, as annotated aliases."""

from functools import partial
from typing import Annotated
from urllib.parse import parse_qsl

from fastapi import Depends, Path, Query, Request
from pydantic import BeforeValidator

from api.http.auth import Caller, CallerDep, holding, note_subject
from api.http.errors import ApiError
from api.limits.admission import Gate
from api.service.runtime import Runtime
from templates.store.identifiers import SUBJECT_ID_RULE, checked_subject_id


async def runtime_of(request: Request) -> Runtime:
    """Return what the process opened at its start."""
    runtime: Runtime = request.app.state.runtime
    return runtime


async def gate_of(request: Request) -> Gate:
    """Return what bounds the process's work."""
    gate: Gate = request.app.state.gate
    return gate


async def subject_of(
    request: Request,
    caller: CallerDep,
    subject_id: Annotated[
        str, Path(description=f"Subject id: has {SUBJECT_ID_RULE}.", examples=["alice"])
    ],
) -> str:
    """Check the subject id, and note its pseudonym for the log.

    Raises
    ------
    InvalidIdentifier
        If it breaks the rule.
    """
    runtime: Runtime = request.app.state.runtime
    note_subject(
        request, runtime.store.signer.pseudonym(caller.tenant, checked_subject_id(subject_id))
    )
    return subject_id


async def enrolls_or_verifies(caller: CallerDep) -> Caller:
    """Demand one of the rights to send a photo, or a token for a browser that will.

    Raises
    ------
    ApiError
        ``forbidden``.
    """
    if not caller.rights & {"enroll", "verify"}:
        raise ApiError(
            "forbidden",
            "this API key lacks the rights enroll and verify, and one of them is needed",
            {"missing": ["enroll", "verify"]},
        )
    return caller


async def refuse_unknown(request: Request) -> None:
    """Refuse what the call does not read: a misspelt name must not pass as the default.

    Every route has it. Fields of bodies are refused where they are read.

    Raises
    ------
    ApiError
        ``validation_failed``: a query parameter that the route does not declare, that comes twice,
        or that is not ``name=value`` in UTF-8; or a body where the call takes none.
    """
    known = [field.alias for field in request.scope["route"].dependant.query_params]
    try:
        query = request.scope["query_string"].decode("ascii")
        names = [name for name, _ in _pairs(query)] if query else []
    except ValueError:
        raise ApiError("validation_failed", "the query is not name=value pairs in UTF-8") from None
    if not set(names) <= set(known) or len(set(names)) < len(names):
        raise ApiError(
            "validation_failed",
            "unknown or repeated query parameter; known are: " + (", ".join(known) or "none"),
            {"known": known},
        )
    headers = request.headers
    sent = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
    if sent and request.method in ("GET", "DELETE"):
        raise ApiError("validation_failed", "this call takes no body: send it without one")


_pairs = partial(parse_qsl, keep_blank_values=True, strict_parsing=True, errors="strict")


def _digits(value: str | int) -> str | int:
    if isinstance(value, str) and not (value.isascii() and value.isdigit()):
        raise ValueError("not a whole number")
    return value


Limit = Annotated[
    int, BeforeValidator(_digits), Query(ge=1, le=1000, description="Entries on one page, at most.")
]
RuntimeDep = Annotated[Runtime, Depends(runtime_of)]
GateDep = Annotated[Gate, Depends(gate_of)]
SubjectDep = Annotated[str, Depends(subject_of)]
Enrolls = Annotated[Caller, Depends(holding("enroll"))]
EnrollsOrVerifies = Annotated[Caller, Depends(enrolls_or_verifies)]
Verifies = Annotated[Caller, Depends(holding("verify"))]
Erases = Annotated[Caller, Depends(holding("erase"))]
Administers = Annotated[Caller, Depends(holding("admin"))]
Exports = Annotated[Caller, Depends(holding("export"))]
