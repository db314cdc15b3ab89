"""Subjects: list, describe, erase."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response

from api.http.audit import by
from api.http.deps import (
    Common,
    Cursor,
    Enrolls,
    Erases,
    GateDep,
    Limit,
    NoPreconditionDep,
    RuntimeDep,
    SubjectDep,
    etag,
)
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.receipts import receipt_json
from api.http.schemas import ReceiptAnswer, Subject, SubjectAnswer, SubjectsAnswer
from templates.contract.document import Binding
from templates.store.subject_rows import SubjectRecord

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "",
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="The tenant's subjects, page by page",
)
async def list_subjects(
    caller: Enrolls,
    runtime: RuntimeDep,
    gate: GateDep,
    common: Common,
    limit: Limit = 100,
    cursor: Cursor = None,
    prefix: Annotated[
        str, Query(max_length=128, description="Only subjects whose ids begin so.")
    ] = "",
) -> SubjectsAnswer:
    """Right: `enroll`. Metadata only, in the order of the subject ids."""
    page = await gate.query(
        lambda: runtime.store.subjects.list(
            caller.tenant, limit=limit, cursor=cursor, prefix=prefix
        )
    )
    binding = runtime.contract.binding
    return SubjectsAnswer(
        **common,
        subjects=[Subject(**_described(record, binding)) for record in page.records],
        next_cursor=page.next_cursor,
    )


@router.get(
    "/{subject_id}",
    responses=error_responses(*EVERY_CALL, "forbidden", "not_enrolled", "validation_failed"),
    summary="One subject",
)
async def get_subject(
    response: Response,
    caller: Enrolls,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    common: Common,
) -> SubjectAnswer:
    """Right: `enroll`. Metadata only, never template bytes."""
    record = await gate.query(lambda: runtime.store.subjects.describe(caller.tenant, subject))
    if record is None:
        raise ApiError("not_enrolled", "nobody is enrolled under this id")
    response.headers["ETag"] = etag(record.template_id)
    return SubjectAnswer(**common, **_described(record, runtime.contract.binding))


@router.delete(
    "/{subject_id}",
    responses=error_responses(*EVERY_CALL, "forbidden", "not_enrolled", "validation_failed"),
    summary="Erase a subject",
)
async def erase_subject(
    request: Request,
    caller: Erases,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    _precondition: NoPreconditionDep,
    common: Common,
) -> ReceiptAnswer:
    """Right: `erase`. Erases template, metadata and data key; answers with a signed receipt.

    Erasing again returns the same receipt, and after another enrollment it erases that one.
    `If-Match` and `If-None-Match` are refused.
    A key that also has `enroll` or `admin` is told of a subject that never was there; another one
    gets a receipt that says nothing was held.
    """

    def work() -> ReceiptAnswer:
        store = runtime.store
        if (
            caller.sees_enrollment
            and store.subjects.describe(caller.tenant, subject) is None
            and store.erasures.receipt(caller.tenant, subject) is None
        ):
            raise ApiError("not_enrolled", "nobody was ever enrolled under this id")
        erasure = store.erasures.erase(caller.tenant, subject, by=by(request))
        request.state.log["log_purged"] = erasure.log_purged
        return ReceiptAnswer(
            **common, **receipt_json(erasure.receipt), log_purged=erasure.log_purged
        )

    return await gate.query(work)


def _described(record: SubjectRecord, binding: Binding) -> dict[str, Any]:
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
