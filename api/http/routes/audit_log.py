"""The audit log of a tenant, for operators' desks."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.auth import note_subject
from api.http.deps import Administers, GateDep, Limit, RuntimeDep
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import AuditLogAnswer
from api.http.values import iso_time
from templates.store.audit_log import Line
from templates.store.cursors import close_cursor, open_cursor
from templates.store.identifiers import checked_subject_id

router = APIRouter(prefix="/v1/audit-log", tags=["Operations"])

_CURSOR_PURPOSE = "audit-log-cursor"


@router.get(
    "",
    response_model=AuditLogAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="The tenant's audit log, page by page",
)
async def get_audit_log(
    request: Request,
    caller: Administers,
    runtime: RuntimeDep,
    gate: GateDep,
    limit: Limit = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    subject_id: Annotated[str | None, Query(description="Only lines on this subject.")] = None,
) -> Response:
    """Right: `admin`. The latest line first; subjects are named by their pseudonyms.

    Whether a line was altered, removed or moved takes the whole log to see, and
    `veilface audit-log verify`.
    """
    store, tenant = runtime.store, caller.tenant
    pseudonym = None
    if subject_id is not None:
        pseudonym = store.signer.pseudonym(tenant, checked_subject_id(subject_id))
        note_subject(request, pseudonym)

    def work() -> dict[str, Any]:
        before = None
        if cursor is not None:
            opened = open_cursor(runtime.keyring, cursor, purpose=_CURSOR_PURPOSE, tenant=tenant)
            before = int(opened)
        lines, earlier = store.audit_log.page(
            tenant, limit=limit, before=before, pseudonym=pseudonym
        )
        return {
            "lines": [_answered(line) for line in lines],
            "next_cursor": None
            if earlier is None
            else close_cursor(
                runtime.keyring, str(earlier), purpose=_CURSOR_PURPOSE, tenant=tenant
            ),
        }

    return answer(request, await gate.query(work))


def _answered(line: Line) -> dict[str, Any]:
    # Without its number, which would tell how much the other tenants do.
    return {
        "at": iso_time(line.at),
        "actor": line.actor,
        "action": line.action,
        "subject": line.pseudonym,
        "outcome": line.outcome,
        "detail": line.detail,
        "request_id": line.request_id,
    }
