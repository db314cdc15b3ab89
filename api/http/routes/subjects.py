"""Subjects: list, describe, erase."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from api.http.auth import Enrolls, Erases
from api.http.deps import Cursor, Limit, NoPreconditionDep, SubjectDep, etag
from api.http.errors import ApiError
from api.http.receipts import receipt_json
from api.http.schemas import ReceiptAnswer, Subject, SubjectAnswer, SubjectsAnswer
from templates.contract.document import Binding
from templates.store.subject_rows import SubjectRecord

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "",
    summary="The tenant's subjects, page by page",
)
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
        **call.common,
        subjects=[Subject(**_described(record, binding)) for record in page.records],
        next_cursor=page.next_cursor,
    )


@router.get(
    "/{subject_id}",
    summary="One subject",
)
async def get_subject(call: Enrolls, subject: SubjectDep, response: Response) -> SubjectAnswer:
    """Right: `enroll`. Metadata only, never template bytes."""
    record = await call.query(lambda: call.store.subjects.describe(call.tenant, subject))
    if record is None:
        raise ApiError("not_enrolled", "nobody is enrolled under this id")
    response.headers["ETag"] = etag(record.template_id)
    return SubjectAnswer(**call.common, **_described(record, call.runtime.contract.binding))


@router.delete(
    "/{subject_id}",
    summary="Erase a subject",
)
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
        return ReceiptAnswer(
            **call.common, **receipt_json(erasure.receipt), log_purged=erasure.log_purged
        )

    return await call.query(work)


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
