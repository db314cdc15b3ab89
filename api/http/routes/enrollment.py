"""Enrollment: photos, or a client's template."""

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import Caller
from api.http.bodies import (
    Form,
    base64_field,
    is_form,
    parse_json,
    reject_unknown,
    sent_form,
    sent_json,
)
from api.http.deps import (
    Enrolls,
    GateDep,
    RuntimeDep,
    SubjectDep,
)
from api.http.errors import ApiError
from api.http.holder_keys import FIELD, HolderKeyHeaderDep, holder_key_of, wiping
from api.http.openapi import BODY, ENROLLMENT_BODY, EVERY_CALL, PHOTO, error_responses
from api.http.preconditions import PreconditionDep, etag
from api.http.schemas import EnrollmentAnswer
from api.http.values import face_policy
from api.limits.admission import Gate
from api.service.runtime import Runtime
from enroll import Enrollment, Holder
from models.quality import Quality
from templates.decoys import Attributes
from templates.store.audit_log import By
from templates.store.subject_rows import Source
from templates.store.subjects import Precondition

router = APIRouter(prefix="/v1/subjects", tags=["Enroll and verify"])

CODES = (
    *EVERY_CALL,
    *BODY,
    *PHOTO,
    "too_many_images",
    "forbidden",
    "replayed",
    "invalid_template",
    "invalid_embedding",
    "contract_mismatch",
    "enrollment_conflict",
    "inconsistent_images",
)


@router.put(
    "/{subject_id}/enrollment",
    response_model=EnrollmentAnswer,
    responses={
        200: {"description": "An earlier enrollment was replaced."},
        201: {"model": EnrollmentAnswer, "description": "The subject is new."},
        **error_responses(*CODES),
    },
    openapi_extra=ENROLLMENT_BODY,
    summary="Enroll a subject, or replace its enrollment",
)
async def enroll(
    request: Request,
    caller: Enrolls,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    holder_key_header: HolderKeyHeaderDep,
    precondition: PreconditionDep,
) -> Response:
    """Rights: `enroll`, and `embeddings` for a template, which the tenant must allow.

    Either 1 to 10 photos, which must show one and the same person, or a private template that the
    client lifted: nothing in it tells whether it holds one person, so it is refused unless the
    operator allowed it (`template_enrollment` of `GET /v1/contract`). All or nothing: a rejected
    set leaves the old enrollment untouched.

    With `holder_key` the template accepts nobody without this key, which the service does not
    keep: a verification must send it too. Who loses it enrolls again.

    An earlier enrollment is replaced, unless a header says otherwise: `If-None-Match: *` never
    replaces, `If-Match: "template id"` replaces only that template. Otherwise the answer is
    `enrollment_conflict`, with the `template_id` that is enrolled, or null.

    A token for this subject may stand in the place of the API key; the enrollment uses it up.
    """
    settings = runtime.settings
    if caller.subject_token is not None:
        precondition = caller.subject_token.precondition(precondition)
    async with gate.admitted(caller.prefix):
        if is_form(request):
            runtime.required_pack()
            form = await sent_form(
                request, settings, field="images", max_images=settings.max_images
            )
            return await _enroll_photos(
                request,
                caller,
                subject,
                form,
                holder_key_header,
                precondition,
            )
        body = await sent_json(request, settings, ("template", FIELD), photos="images")
        # After the fields: a caller that only forgot how to send a photo needs no further right.
        caller.require("embeddings")
        await gate.query(lambda: runtime.require_template_enrollment(caller.tenant))
        template = base64_field(body.get("template"), "template", code="invalid_template")
        holder_key = holder_key_of(holder_key_header, body)

        def work() -> dict[str, Any]:
            token = _unused_token(runtime, caller)
            epoch = runtime.epoch(caller.tenant)
            enrollment = runtime.enroller(caller.tenant, epoch).from_template(
                template, holder=_holder(holder_key, caller, subject)
            )
            return _stored(
                runtime,
                caller.tenant,
                subject,
                epoch,
                enrollment,
                Source.TEMPLATE,
                precondition,
                token,
                by(request),
            )

        body = await gate.compute(wiping(holder_key, work), key=caller.prefix)
        return _written(request, body)


async def _enroll_photos(
    request: Request,
    caller: Caller,
    subject: str,
    form: Form,
    holder_key_header: str | None,
    precondition: Precondition | None,
) -> Response:
    runtime: Runtime = request.app.state.runtime
    gate: Gate = request.app.state.gate
    pack, photos = runtime.required_pack(), form.images("images")
    reject_unknown(form.fields, ("attributes", "face", FIELD))
    policy = face_policy(form.fields.get("face"))
    attributes = parse_attributes(form.fields.get("attributes"))
    holder_key = holder_key_of(holder_key_header, form.fields)

    def work() -> dict[str, Any]:
        token = _unused_token(runtime, caller)
        epoch = runtime.epoch(caller.tenant)
        enrollment = runtime.enroller(caller.tenant, epoch).from_photos(
            pack,
            photos,
            attributes=attributes,
            holder=_holder(holder_key, caller, subject),
            policy=policy,
            limits=runtime.image_limits,
        )
        return _stored(
            runtime,
            caller.tenant,
            subject,
            epoch,
            enrollment,
            Source.PHOTOS,
            precondition,
            token,
            by(request),
        )

    body = await gate.compute(wiping(holder_key, work), key=caller.prefix)
    return _written(request, body)


def parse_attributes(text: str | None) -> Attributes:
    """Read the form field ``attributes``; it is used for lifting and then forgotten.

    Raises
    ------
    ApiError
        ``validation_failed``; the message never repeats the input.
    """
    if text is None:
        return Attributes()
    try:
        value = parse_json(text)
    except (ValueError, RecursionError):
        value = None
    if (
        not isinstance(value, dict)
        or not set(value) <= {"gender", "race"}
        or not all(
            isinstance(label, str) and 0 < len(label) <= 64 and label.isprintable()
            for label in value.values()
        )
    ):
        raise ApiError(
            "validation_failed",
            "attributes must be a JSON object with texts for gender and race, or one of them",
            {"field": "attributes"},
        )
    return Attributes(gender=value.get("gender"), race=value.get("race"))


def _holder(key: bytearray | None, caller: Caller, subject: str) -> Holder | None:
    return None if key is None else Holder(key, caller.tenant, subject)


def _unused_token(runtime: Runtime, caller: Caller) -> str | None:
    """Return the digest of what the enrollment uses up; None where it came with an API key.

    Raises
    ------
    Replayed
        Where the token was used or is late: before anything is decoded.
    """
    if caller.subject_token is None:
        return None
    # Once more: the body and the turn to compute may have taken a while.
    caller.subject_token.require_in_time()
    runtime.store.audit_log.require_unused(caller.subject_token.digest)
    return caller.subject_token.digest


def _quality(quality: object) -> dict[str, Any]:
    return quality.as_dict() if isinstance(quality, Quality) else {}


def _stored(
    runtime: Runtime,
    tenant: str,
    subject: str,
    epoch: int,
    enrollment: Enrollment,
    source: Source,
    precondition: Precondition | None,
    token: str | None,
    who: By,
) -> dict[str, Any]:
    stored = runtime.put(
        tenant,
        subject,
        epoch,
        enrollment,
        source=source,
        photos=enrollment.photos,
        precondition=precondition,
        token=token,
        by=who,
    )
    return {
        "template_id": stored.template_id,
        "contract_id": enrollment.contract_id,
        "replaced": not stored.created,
        "holder_key": enrollment.holder_salt is not None,
        "images": [
            {"index": result.index, "status": "used", "quality": _quality(result.quality)}
            for result in enrollment.per_photo
        ],
    }


def _written(request: Request, body: dict[str, Any]) -> Response:
    return answer(
        request,
        body,
        status=200 if body["replaced"] else 201,
        headers={"ETag": etag(body["template_id"])},
    )
