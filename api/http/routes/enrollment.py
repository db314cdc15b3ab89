"""Enrollment: photos, or a client's template."""

from dataclasses import asdict

from fastapi import APIRouter, Response

from api.http.auth import Enrolls
from api.http.bodies import is_form, read_form, read_json
from api.http.deps import PreconditionDep, SubjectDep, etag
from api.http.openapi import body_of
from api.http.requests import EnrollmentForm, EnrollmentJson
from api.http.schemas import EnrollmentAnswer, Photo
from enroll import Holder
from enroll.enroller import MAX_PHOTOS
from templates.decoys import Attributes
from templates.keys.holder_key import wipe
from templates.store.schema import Source

router = APIRouter(prefix="/v1/subjects", tags=["Enroll and verify"])


@router.put(
    "/{subject_id}/enrollment",
    responses={
        200: {"description": "An earlier enrollment was replaced."},
        201: {"model": EnrollmentAnswer, "description": "The subject is new."},
    },
    openapi_extra=body_of(form=EnrollmentForm, json=EnrollmentJson),
    summary="Enroll a subject, or replace its enrollment",
)
async def enroll(
    call: Enrolls, subject: SubjectDep, precondition: PreconditionDep, response: Response
) -> EnrollmentAnswer:
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
    runtime, tenant = call.runtime, call.tenant
    request, token = call.request, call.token
    if token is not None:
        precondition = token.precondition(precondition)
    async with call.place():
        sent: EnrollmentForm | EnrollmentJson
        if is_form(request):
            runtime.required_pack()
            sent = await read_form(request, EnrollmentForm, photos="images", most=MAX_PHOTOS)
        else:
            sent = await read_json(request, EnrollmentJson, photos="images")
            # After the fields: a caller who only sent the photo wrongly is told so first, not
            # that a right is missing.
            call.require("embeddings")
            await call.query(lambda: runtime.require_template_enrollment(tenant))

        def work() -> EnrollmentAnswer:
            if token is not None:
                # Once more: the body and the turn to compute may have taken a while.
                token.require_in_time()
            epoch, key = runtime.current_epoch(tenant), sent.holder_key
            holder = None if key is None else Holder(key, tenant, subject)
            try:
                if isinstance(sent, EnrollmentJson):
                    enrollment = epoch.enroller.from_template(sent.template, holder=holder)
                else:
                    enrollment = epoch.enroller.from_photos(
                        runtime.required_pack(),
                        sent.images,
                        attributes=Attributes(**sent.attributes),
                        holder=holder,
                        policy=sent.face,
                    )
            finally:
                wipe(key)
            replaced = runtime.put(
                tenant,
                subject,
                epoch,
                enrollment,
                source=Source.PHOTOS if isinstance(sent, EnrollmentForm) else Source.TEMPLATE,
                photos=enrollment.photos,
                precondition=precondition,
                token=None if token is None else token.digest,
                by=call.by,
            )
            return EnrollmentAnswer(
                template_id=enrollment.template_id,
                contract_id=enrollment.contract_id,
                replaced=replaced,
                holder_key=enrollment.holder_salt is not None,
                images=[
                    Photo(index=index, status="used", quality=asdict(quality))
                    for index, quality in enumerate(enrollment.qualities)
                ],
            )

        answer = await call.compute(work)
    response.status_code = 200 if answer.replaced else 201
    response.headers["ETag"] = etag(answer.template_id)
    return answer
