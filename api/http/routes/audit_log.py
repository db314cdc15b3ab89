"""The audit log of a tenant, for operators' desks."""

from typing import Annotated

from fastapi import APIRouter, Query

from api.http.auth import Administers
from api.http.deps import Cursor, Limit
from api.http.schemas import AuditLine, AuditLogAnswer
from templates.store.cursors import close_cursor, open_cursor
from templates.store.identifiers import checked_subject_id

router = APIRouter(prefix="/v1/audit-log", tags=["Operations"])

_CURSOR_PURPOSE = "audit-log-cursor"


@router.get("", summary="The tenant's audit log, page by page")
async def get_audit_log(
    call: Administers,
    limit: Limit = 100,
    cursor: Cursor = None,
    subject_id: Annotated[str | None, Query(description="Only lines on this subject.")] = None,
) -> AuditLogAnswer:
    """Right: `admin`. The latest line first; subjects are named by their pseudonyms.

    Whether a line was altered, removed or moved takes the whole log to see, and
    `veilface audit-log verify`.
    """
    keyring, pseudonym = call.runtime.keyring, None
    if subject_id is not None:
        pseudonym = call.note_subject(checked_subject_id(subject_id))

    def work() -> AuditLogAnswer:
        before = None
        if cursor is not None:
            opened = open_cursor(keyring, cursor, purpose=_CURSOR_PURPOSE, tenant=call.tenant)
            before = int(opened)
        lines, earlier = call.store.audit_log.page(
            call.tenant, limit=limit, before=before, pseudonym=pseudonym
        )
        return AuditLogAnswer(
            # Without its number, which would tell how much the other tenants do.
            lines=[
                AuditLine(
                    at=line.at,
                    actor=line.actor,
                    action=line.action,
                    subject=line.pseudonym,
                    outcome=line.outcome,
                    detail=line.detail,
                    request_id=line.request_id,
                )
                for line in lines
            ],
            next_cursor=None
            if earlier is None
            else close_cursor(keyring, str(earlier), purpose=_CURSOR_PURPOSE, tenant=call.tenant),
        )

    return await call.query(work)
