"""What is stored of a subject, and what an audit found of templates like it."""

from fastapi import APIRouter, Depends, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.audit_report import NOT_AUDITED, AuditReport, kind_of_decoys
from api.http.auth import caller
from api.http.deps import Enrolls, GateDep, RuntimeDep, SubjectDep
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import AuditAnswer, StoredAnswer
from api.http.values import iso_time
from templates.contract import wire
from templates.space.lifting import Strategy
from templates.store.audit_log import Entry
from templates.store.subjects import StoredForm

router = APIRouter(prefix="/v1", tags=["stored"])

EXCERPT_BYTES = 64


@router.get(
    "/subjects/{subject_id}/stored",
    response_model=StoredAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "not_enrolled", "validation_failed"),
    summary="What is stored of a subject",
)
async def get_stored(
    request: Request, caller: Enrolls, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `enroll`. Sizes, an excerpt of the ciphertext, and how far the foot point lies out.

    No byte and no direction of the template: the length of its foot point, to three digits, is
    the one number that is read from it. A line in the audit log says who looked.
    """

    def work() -> tuple[StoredForm, float] | None:
        form = runtime.store.subjects.stored_form(caller.tenant, subject)
        if form is None:
            return None
        norm = wire.decode(form.template.wire).subspace.foot_norm
        # It opens a template and tells when its person was last here: the line stands first.
        store = runtime.store
        line = Entry(
            "inspect",
            "inspected",
            by(request),
            caller.tenant,
            store.signer.pseudonym(caller.tenant, subject),
        )
        store.audit_log.record(line)
        return form, norm

    # Reading a template orthonormalises its basis: it takes a slot as a decision does.
    async with gate.admitted(caller.prefix):
        read = await gate.compute(work, key=caller.prefix)
    if read is None:
        raise ApiError("not_enrolled", "nobody is enrolled under this id")
    form, norm = read
    record = form.template.record
    binding = runtime.contract.binding
    strategy, current = binding.strategy, record.contract_id == binding.contract_id
    return answer(
        request,
        {
            "subject_id": subject,
            "template_id": record.template_id,
            "contract_id": record.contract_id,
            "current": current,
            "strategy": str(strategy) if current else None,
            "decoys": Strategy(strategy).decoys(record.m) if current else None,
            "n": record.n,
            "m": record.m,
            "dtype": record.dtype,
            "wire_bytes": len(form.template.wire),
            "sealed_bytes": len(form.sealed),
            "sealed_excerpt": _middle(form.sealed, EXCERPT_BYTES).hex(),
            "foot_point_similarity": round(norm, 3),
            "enrolled_by": str(record.source),
            "photos": record.photos,
            "created_at": iso_time(record.created_at),
            "updated_at": iso_time(record.updated_at),
            "last_used_at": iso_time(form.last_used_at),
        },
    )


@router.get(
    "/contract/audit",
    dependencies=[Depends(caller)],
    response_model=AuditAnswer,
    responses=error_responses(*EVERY_CALL),
    summary="What an audit found of templates like these",
)
async def get_audit(request: Request, runtime: RuntimeDep) -> Response:
    """Any valid key may read it: the figures of the report that `audit_report_file` names."""
    report: AuditReport | None = request.app.state.audit_report
    if report is None:
        return answer(request, NOT_AUDITED)
    return answer(request, report.reduced(runtime.contract, kind_of_decoys(runtime.source)))


def _middle(data: bytes, count: int) -> bytes:
    """Cut some bytes from the middle: away from the nonce and the authentication tag."""
    start = max(0, (len(data) - count) // 2)
    return data[start : start + count]
