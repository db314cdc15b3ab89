"""Export and import of one subject, encrypted."""

import base64
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import note_subject
from api.http.bodies import base64_field, sent_json
from api.http.deps import Exports, GateDep, RuntimeDep, SubjectDep
from api.http.errors import ApiError
from api.http.openapi import BODY, EVERY_CALL, IMPORT_BODY, error_responses
from api.http.preconditions import PreconditionDep, etag
from api.http.schemas import ExportAnswer, ImportAnswer
from api.http.transfer import open_export
from templates.store.identifiers import checked_subject_id
from templates.store.subject_rows import Source

router = APIRouter(prefix="/v1/subjects", tags=["People"])


@router.get(
    "/{subject_id}/export",
    response_model=ExportAnswer,
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
    request: Request, caller: Exports, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
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
    return answer(
        request,
        {
            "export": base64.b64encode(exported).decode("ascii"),
            "contract_id": runtime.contract.contract_id,
            "key_id": runtime.export_key.key_id,
        },
    )


@router.post(
    "/import",
    response_model=ImportAnswer,
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
    openapi_extra=IMPORT_BODY,
    summary="Import a subject that was exported",
)
async def import_subject(
    request: Request,
    caller: Exports,
    runtime: RuntimeDep,
    gate: GateDep,
    precondition: PreconditionDep,
) -> Response:
    """Rights: `export` and `admin`. The template gets a new id, and a rotation of the tenant's.

    It needs a holder's key where it did before, and the same one. An old export brings back who was
    erased since, and undoes a later enrollment: the audit log has a line, with the action `import`.
    `If-None-Match` and `If-Match` say what may be replaced, as of an enrollment.
    """
    caller.require("admin")
    settings = runtime.settings
    async with gate.admitted(caller.prefix):
        body = await sent_json(request, settings, ("export",))
        data = base64_field(body.get("export"), "export", code="invalid_template")
        exported = await gate.query(
            lambda: open_export(
                data,
                key=runtime.export_key,
                tenant=caller.tenant,
                contract_id=runtime.contract.contract_id,
            )
        )
        subject = checked_subject_id(exported.subject_id)
        note_subject(request, runtime.store.signer.pseudonym(caller.tenant, subject))

        def work() -> dict[str, Any]:
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
                source=Source(exported.source),
                photos=exported.photos,
                precondition=precondition,
                action="import",
                by=by(request),
            )
            return {
                "template_id": stored.template_id,
                "contract_id": enrollment.contract_id,
                "replaced": not stored.created,
                "holder_key": salt is not None,
                "subject_id": exported.subject_id,
            }

        body = await gate.compute(work, key=caller.prefix)
    return answer(
        request,
        body,
        status=200 if body["replaced"] else 201,
        headers={"ETag": etag(body["template_id"])},
    )
