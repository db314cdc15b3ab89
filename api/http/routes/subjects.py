"""Subjects: list, describe, erase."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.deps import (
    Enrolls,
    Erases,
    GateDep,
    Limit,
    RuntimeDep,
    SubjectDep,
)
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.preconditions import NoPreconditionDep, etag
from api.http.receipts import receipt_json
from api.http.schemas import ReceiptAnswer, SubjectAnswer, SubjectsAnswer
from api.http.values import iso_time
from templates.contract.document import Binding
from templates.store.subject_rows import SubjectRecord

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "",
    response_model=SubjectsAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="The tenant's subjects, page by page",
)
async def list_subjects(
    request: Request,
    caller: Enrolls,
    runtime: RuntimeDep,
    gate: GateDep,
    limit: Limit = 100,
    cursor: Annotated[str | None, Query(description="`next_cursor` of the page before.")] = None,
    prefix: Annotated[
        str, Query(max_length=128, description="Only subjects whose ids begin so.")
    ] = "",
) -> Response:
    """Right: `enroll`. Metadata only, in the order of the subject ids."""
    page = await gate.query(
        lambda: runtime.store.subjects.list(
            caller.tenant, limit=limit, cursor=cursor, prefix=prefix
        )
    )
    return answer(
        request,
        {
            "subjects": [_described(record, runtime.contract.binding) for record in page.records],
            "next_cursor": page.next_cursor,
        },
    )


@router.get(
    "/{subject_id}",
    response_model=SubjectAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "not_enrolled", "validation_failed"),
    summary="One subject",
)
async def get_subject(
    request: Request, caller: Enrolls, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `enroll`. Metadata only, never template bytes."""
    record = await gate.query(lambda: runtime.store.subjects.describe(caller.tenant, subject))
    if record is None:
        raise ApiError("not_enrolled", "nobody is enrolled under this id")
    return answer(
        request,
        _described(record, runtime.contract.binding),
        headers={"ETag": etag(record.template_id)},
    )


@router.delete(
    "/{subject_id}",
    response_model=ReceiptAnswer,
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
) -> Response:
    """Right: `erase`. Erases template, metadata and data key; answers with a signed receipt.

    Erasing again returns the same receipt, and after another enrollment it erases that one.
    `If-Match` and `If-None-Match` are refused.
    A key that also has `enroll` or `admin` is told of a subject that never was there; another one
    gets a receipt that says nothing was held.
    """

    def work() -> dict[str, Any]:
        store = runtime.store
        if (
            caller.sees_enrollment
            and store.subjects.describe(caller.tenant, subject) is None
            and store.erasures.receipt(caller.tenant, subject) is None
        ):
            raise ApiError("not_enrolled", "nobody was ever enrolled under this id")
        erasure = store.erasures.erase(caller.tenant, subject, by=by(request))
        request.state.log["log_purged"] = erasure.log_purged
        return {**receipt_json(erasure.receipt), "log_purged": erasure.log_purged}

    return answer(request, await gate.query(work))


def _described(record: SubjectRecord, binding: Binding) -> dict[str, Any]:
    return {
        "subject_id": record.subject_id,
        "template_id": record.template_id,
        "contract_id": record.contract_id,
        "current": record.contract_id == binding.contract_id,
        "enrolled_by": str(record.source),
        "photos": record.photos,
        "holder_key": record.holder_salt is not None,
        "created_at": iso_time(record.created_at),
        "updated_at": iso_time(record.updated_at),
    }
