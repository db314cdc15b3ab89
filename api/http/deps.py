"""Dependencies of the routes, as annotated aliases."""

from collections.abc import Collection
from typing import Annotated

from fastapi import Depends, Header, Path, Request

from api.http.auth import Caller, CallerDep, holding, note_subject
from api.http.errors import ApiError
from api.limits.admission import Gate
from api.process.runtime import Runtime
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


async def idempotency_key_of(
    idempotency_key: Annotated[
        str | None,
        Header(
            description="1 to 255 visible characters. The same key with the same request gives "
            "the stored answer for 24 hours; with another request, `idempotency_conflict`.",
            examples=["9b2c6a0e-5c5f-4f5e-8f0b-1d9f4c1f7a11"],
        ),
    ] = None,
) -> str | None:
    """Check the Idempotency-Key header.

    Raises
    ------
    ApiError
        ``validation_failed``.
    """
    if idempotency_key is None:
        return None
    visible = all("!" <= character <= "~" for character in idempotency_key)
    if not visible or not 1 <= len(idempotency_key) <= 255:
        raise ApiError(
            "validation_failed",
            "Idempotency-Key must have 1 to 255 visible ASCII characters",
            {"field": "Idempotency-Key"},
        )
    return idempotency_key


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


def query_of(request: Request, known: Collection[str]) -> dict[str, str]:
    """Return the query, refusing what nobody reads: a misspelt `level` is not the default.

    Raises
    ------
    ApiError
        ``validation_failed``.
    """
    query: dict[str, str] = {}
    for name, value in request.query_params.multi_items():
        if name not in known or name in query:
            raise ApiError(
                "validation_failed",
                "unknown or repeated query parameter; known are: " + (", ".join(known) or "none"),
                {"known": list(known)},
            )
        query[name] = value
    return query


RuntimeDep = Annotated[Runtime, Depends(runtime_of)]
GateDep = Annotated[Gate, Depends(gate_of)]
SubjectDep = Annotated[str, Depends(subject_of)]
IdempotencyDep = Annotated[str | None, Depends(idempotency_key_of)]
Enrolls = Annotated[Caller, Depends(holding("enroll"))]
EnrollsOrVerifies = Annotated[Caller, Depends(enrolls_or_verifies)]
Verifies = Annotated[Caller, Depends(holding("verify"))]
Erases = Annotated[Caller, Depends(holding("erase"))]
Administers = Annotated[Caller, Depends(holding("admin"))]
Exports = Annotated[Caller, Depends(holding("export"))]
