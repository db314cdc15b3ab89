"""Export and import of one subject, encrypted."""

import base64

from fastapi import APIRouter, Request, Response

from api.http.audit import by
from api.http.auth import note_subject
from api.http.bodies import read_json
from api.http.deps import (
    Common,
    Exports,
    GateDep,
    PreconditionDep,
    RuntimeDep,
    SubjectDep,
    etag,
)
from api.http.errors import ApiError
from api.http.openapi import BODY, EVERY_CALL, body_of, error_responses
from api.http.requests import ImportJson
from api.http.schemas import ExportAnswer, ImportAnswer
from api.http.transfer import open_export
from templates.store.identifiers import checked_subject_id
from templates.store.subject_rows import Source

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "/{subject_id}/export",
    responses=error_responses(
        *EVERY_CALL,
        "forbidden",
        "not_enrolled",
        "not_found",
        "validation_failed",
        "contract_mismatch",
    ),
    summary="Export a subject, encrypted",
)
async def export_subject(
    request: Request,
    caller: Exports,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    common: Common,
) -> ExportAnswer:
    """Right: `export`. The template is un-rotated inside the encryption; a holder's rotation stays.

    Only keys with `enroll` or `admin` are told `not_enrolled`; others get `not_found`.
    """
    async with gate.admitted(caller.prefix):
        exported = await gate.compute(
            lambda: runtime.export(caller.tenant, subject, by=by(request)), key=caller.prefix
        )
    if exported is None:
        if caller.sees_enrollment:
            raise ApiError("not_enrolled", "nobody is enrolled under this id")
        raise ApiError("not_found", "there is nothing to export")
    return ExportAnswer(
        **common,
        export=base64.b64encode(exported).decode("ascii"),
        contract_id=runtime.contract.contract_id,
        key_id=runtime.export_key.key_id,
    )


@router.post(
    "/import",
    responses={
        200: {"description": "An earlier enrollment was replaced."},
        201: {"model": ImportAnswer, "description": "The subject is new."},
        **error_responses(
            *EVERY_CALL,
            *BODY,
            "forbidden",
            "invalid_template",
            "contract_mismatch",
            "enrollment_conflict",
        ),
    },
    openapi_extra=body_of(json=ImportJson),
    summary="Import a subject that was exported",
)
async def import_subject(
    request: Request,
    response: Response,
    caller: Exports,
    runtime: RuntimeDep,
    gate: GateDep,
    precondition: PreconditionDep,
    common: Common,
) -> ImportAnswer:
    """Rights: `export` and `admin`. The template gets a new id, and a rotation of the tenant's.

    It needs a holder's key where it did before, and the same one. An old export brings back who was
    erased since, and undoes a later enrollment: the audit log has a line, with the action `import`.
    `If-None-Match` and `If-Match` say what may be replaced, as of an enrollment.
    """
    caller.require("admin")
    async with gate.admitted(caller.prefix):
        sent = await read_json(request, runtime.settings, ImportJson)
        exported = await gate.query(
            lambda: open_export(
                sent.export,
                key=runtime.export_key,
                tenant=caller.tenant,
                contract_id=runtime.contract.contract_id,
            )
        )
        note_subject(request, caller, checked_subject_id(exported.subject_id))

        def work() -> ImportAnswer:
            epoch = runtime.epoch(caller.tenant)
            enroller = runtime.enroller(caller.tenant, epoch)
            salt = exported.holder_salt
            # A template that the service made of photos is no client's. One that is in a holder's
            # rotation cannot be held against strangers: it was when it was enrolled.
            if exported.source == Source.PHOTOS or salt is not None:
                enrollment = enroller.from_export(exported.wire, holder_salt=salt)
            else:
                enrollment = enroller.from_template(exported.wire)

            stored = runtime.put(
                caller.tenant,
                exported.subject_id,
                epoch,
                enrollment,
                source=exported.source,
                photos=exported.photos,
                precondition=precondition,
                action="import",
                by=by(request),
            )
            return ImportAnswer(
                **common,
                subject_id=exported.subject_id,
                template_id=stored.template_id,
                contract_id=enrollment.contract_id,
                replaced=not stored.created,
                holder_key=salt is not None,
            )

        answer = await gate.compute(work, key=caller.prefix)
    response.status_code = 200 if answer.replaced else 201
    response.headers["ETag"] = etag(answer.template_id)
    return answer
