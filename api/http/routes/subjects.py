"""Subjects: list, describe, erase; their lockout, for operators' desks."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from api.http.auth import Administers, Enrolls, Erases
from api.http.deps import Cursor, Limit, NoPreconditionDep, SubjectDep, etag
from api.http.errors import ApiError
from api.http.receipts import receipt_json
from api.http.schemas import (
    LockoutAnswer,
    ReceiptAnswer,
    Subject,
    SubjectAnswer,
    SubjectsAnswer,
    UnlockAnswer,
)
from templates.contract.document import Binding
from templates.store.schema import SubjectRow

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get("", summary="The tenant's subjects, page by page")
async def list_subjects(
    call: Enrolls,
    limit: Limit = 100,
    cursor: Cursor = None,
    prefix: Annotated[
        str, Query(max_length=128, description="Only subjects whose ids begin so.")
    ] = "",
) -> SubjectsAnswer:
    """Right: `enroll`. Metadata only, in the order of the subject ids."""
    page = await call.query(
        lambda: call.store.subjects.list(call.tenant, limit=limit, cursor=cursor, prefix=prefix)
    )
    binding = call.runtime.contract.binding
    return SubjectsAnswer(
        subjects=[Subject(**_described(record, binding)) for record in page.records],
        next_cursor=page.next_cursor,
    )


@router.get("/{subject_id}", summary="One subject")
async def get_subject(call: Enrolls, subject: SubjectDep, response: Response) -> SubjectAnswer:
    """Right: `enroll`. Metadata only, never template bytes."""
    record = await call.query(lambda: call.store.subjects.describe(call.tenant, subject))
    if record is None:
        raise ApiError("not_enrolled", "nobody is enrolled under this id")
    response.headers["ETag"] = etag(record.template_id)
    return SubjectAnswer(**_described(record, call.runtime.contract.binding))


@router.delete("/{subject_id}", summary="Erase a subject")
async def erase_subject(
    call: Erases, subject: SubjectDep, _precondition: NoPreconditionDep
) -> ReceiptAnswer:
    """Right: `erase`. Erases template, metadata and data key; answers with a signed receipt.

    Erasing again returns the same receipt, and after another enrollment it erases that one.
    `If-Match` and `If-None-Match` are refused.
    A key that also has `enroll` or `admin` is told of a subject that never was there; another one
    gets a receipt that says nothing was held.
    """

    def work() -> ReceiptAnswer:
        store, tenant = call.store, call.tenant
        if (
            call.sees_enrollment
            and store.subjects.describe(tenant, subject) is None
            and store.erasures.receipt(tenant, subject) is None
        ):
            raise ApiError("not_enrolled", "nobody was ever enrolled under this id")
        erasure = store.erasures.erase(tenant, subject, by=call.by)
        call.request.state.log["log_purged"] = erasure.log_purged
        return ReceiptAnswer(**receipt_json(erasure.receipt), log_purged=erasure.log_purged)

    return await call.query(work)


@router.get("/{subject_id}/lockout", summary="Failed attempts on a subject")
async def get_lockout(call: Administers, subject: SubjectDep) -> LockoutAnswer:
    """Right: `admin`. A subject that does not exist is counted like one that does.

    `not_found` where no verification failed since the last accept or reset.
    """
    status = await call.query(lambda: call.store.attempts.status(call.tenant, subject))
    if status is None or (status.consecutive == 0 and status.disabled_at is None):
        raise ApiError("not_found", "this subject has no failed attempts")
    return LockoutAnswer(
        consecutive_failures=status.consecutive,
        last_failed_at=status.last_failed_at,
        locked_until=status.locked_until,
        disabled_at=status.disabled_at,
    )


@router.delete("/{subject_id}/lockout", summary="Lift the lockout of a subject")
async def unlock_subject(call: Administers, subject: SubjectDep) -> UnlockAnswer:
    """Right: `admin`. Forgets the failed attempts, and enables a subject that was disabled.

    Make sure first that it was the subject who failed: after this, an attacker may try again too.
    """
    lifted = await call.query(lambda: call.store.attempts.reset(call.tenant, subject, by=call.by))
    return UnlockAnswer(lifted=lifted)


def _described(record: SubjectRow, binding: Binding) -> dict[str, Any]:
    return {
        "subject_id": record.subject_id,
        "template_id": record.template_id,
        "contract_id": record.contract_id,
        "current": record.contract_id == binding.contract_id,
        "enrolled_by": record.source.value,
        "photos": record.photos,
        "holder_key": record.holder_salt is not None,
        "created_at": record.created_at,
        "updated_at": record.updated_at,
    }
