"""Export and import of one subject, encrypted."""

import base64

from fastapi import APIRouter, Response

from api.http.auth import Exports
from api.http.bodies import read_json
from api.http.deps import PreconditionDep, SubjectDep, etag
from api.http.errors import ApiError
from api.http.openapi import body_of
from api.http.requests import ImportJson
from api.http.schemas import ExportAnswer, ImportAnswer
from api.http.transfer import open_export
from templates.store.identifiers import checked_subject_id
from templates.store.schema import Source

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get("/{subject_id}/export", summary="Export a subject, encrypted")
async def export_subject(call: Exports, subject: SubjectDep) -> ExportAnswer:
    """Right: `export`. The template is un-rotated inside the encryption; a holder's rotation stays.

    Only keys with `enroll` or `admin` are told `not_enrolled`; others get `not_found`.
    """
    runtime = call.runtime
    async with call.place():
        exported = await call.compute(lambda: runtime.export(call.tenant, subject, by=call.by))
    if exported is None:
        if call.sees_enrollment:
            raise ApiError("not_enrolled", "nobody is enrolled under this id")
        raise ApiError("not_found", "there is nothing to export")
    return ExportAnswer(
        export=base64.b64encode(exported).decode("ascii"),
        contract_id=runtime.contract.contract_id,
        key_id=runtime.export_key.key_id,
    )


@router.post(
    "/import",
    responses={
        200: {"description": "An earlier enrollment was replaced."},
        201: {"model": ImportAnswer, "description": "The subject is new."},
    },
    openapi_extra=body_of(json=ImportJson),
    summary="Import a subject that was exported",
)
async def import_subject(
    call: Exports, precondition: PreconditionDep, response: Response
) -> ImportAnswer:
    """Rights: `export` and `admin`. The template gets a new id, and a rotation of the tenant's.

    It needs a holder's key where it did before, and the same one. An old export brings back who was
    erased since, and undoes a later enrollment: the audit log has a line, with the action `import`.
    `If-None-Match` and `If-Match` say what may be replaced, as of an enrollment.
    """
    call.require("admin")
    runtime = call.runtime
    async with call.place():
        sent = await read_json(call.request, ImportJson)
        exported = await call.query(
            lambda: open_export(
                sent.export,
                key=runtime.export_key,
                tenant=call.tenant,
                contract_id=runtime.contract.contract_id,
            )
        )
        call.note_subject(checked_subject_id(exported.subject_id))

        def work() -> ImportAnswer:
            epoch, salt = runtime.current_epoch(call.tenant), exported.holder_salt
            # A template that the service made of photos is no client's. One that is in a holder's
            # rotation cannot be held against strangers: it was when it was enrolled.
            if exported.source == Source.PHOTOS or salt is not None:
                enrollment = epoch.enroller.from_export(exported.wire, holder_salt=salt)
            else:
                enrollment = epoch.enroller.from_template(exported.wire)

            replaced = runtime.put(
                call.tenant,
                exported.subject_id,
                epoch,
                enrollment,
                source=exported.source,
                photos=exported.photos,
                precondition=precondition,
                action="import",
                by=call.by,
            )
            return ImportAnswer(
                subject_id=exported.subject_id,
                template_id=enrollment.template_id,
                contract_id=enrollment.contract_id,
                replaced=replaced,
                holder_key=salt is not None,
            )

        answer = await call.compute(work)
    response.status_code = 200 if answer.replaced else 201
    response.headers["ETag"] = etag(answer.template_id)
    return answer
