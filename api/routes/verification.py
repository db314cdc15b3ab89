"""Verification: a photo, an embedding or a lifted probe against one subject."""

from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.answers import answer
from api.auth import Caller
from api.bodies import base64_field, content_type, read_form, read_json, reject_unknown
from api.deps import GateDep, RuntimeDep, SubjectDep, Verifies, query_of
from api.errors import ApiError
from api.openapi import BODY, EVERY_CALL, PHOTO, VERIFY_BODY, error_responses
from api.runtime import Runtime
from api.schemas import VerifyAnswer
from api.values import embedding_of, face_policy, one_of
from templates.errors import ContractMismatch
from verify import Decision, StandIn, Verifier

router = APIRouter(prefix="/v1/subjects", tags=["subjects"])

Decide = Callable[[Verifier, bytes | StandIn], Decision]

CODES = (
    *EVERY_CALL,
    *BODY,
    *PHOTO,
    "forbidden",
    "not_enrolled",
    "invalid_template",
    "invalid_embedding",
    "contract_mismatch",
    "uncalibrated",
    "replayed",
    "locked_out",
    "rate_limited",
)


@router.post(
    "/{subject_id}/verify",
    response_model=VerifyAnswer,
    response_model_exclude_none=True,
    responses=error_responses(*CODES),
    openapi_extra=VERIFY_BODY,
    summary="Is this the subject?",
)
async def verify(
    request: Request, caller: Verifies, subject: SubjectDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Rights: `verify`, and `embeddings` for a probe that is no photo.

    A subject that does not exist is answered as one that does not match, in the same shape and
    with the same work, and so is one that was enrolled under another contract; only keys with
    `enroll` or `admin` are told `not_enrolled` or `contract_mismatch`. The distance is returned
    only to keys with `scores`.
    """
    query = query_of(request, ("level", "face"))
    async with gate.admitted():
        if content_type(request) == "multipart/form-data":
            decide = await _photo_probe(request, runtime, query)
        else:
            decide = await _sent_probe(request, runtime, caller, query)
        decision = await gate.compute(lambda: _decide(runtime, caller, subject, decide))
    request.state.log["security_level"] = decision.level
    request.state.log["decision"] = "accept" if decision.accepted else "reject"
    body: dict[str, Any] = {
        "decision": "accept" if decision.accepted else "reject",
        "reason": decision.reason,
        "level": decision.level,
        "fmr": decision.fmr,
        "contract_id": decision.contract_id,
        "calibration_id": decision.calibration_id,
    }
    if "scores" in caller.rights:
        body["distance"] = decision.distance
    return answer(request, body)


async def _photo_probe(request: Request, runtime: Runtime, query: dict[str, str]) -> Decide:
    pack = runtime.required_pack()
    settings = runtime.settings
    form = await read_form(
        request,
        max_bytes=settings.max_request_bytes,
        max_images=1,
        max_image_bytes=settings.max_image_bytes,
        timeout_s=settings.body_timeout_s,
    )
    photo = form.images("image")[0]
    reject_unknown(form.fields, ("level", "face"))
    level = one_of(form.fields, query, "level")
    policy = face_policy(one_of(form.fields, query, "face"))

    def decide(verifier: Verifier, stored: bytes | StandIn) -> Decision:
        return verifier.decide_photo(
            pack, photo, stored, level=level, policy=policy, limits=runtime.image_limits
        )

    return decide


async def _sent_probe(
    request: Request, runtime: Runtime, caller: Caller, query: dict[str, str]
) -> Decide:
    caller.require("embeddings")
    settings = runtime.settings
    body = await read_json(
        request, max_bytes=settings.max_request_bytes, timeout_s=settings.body_timeout_s
    )
    reject_unknown(body, ("embedding", "template", "level"))
    if ("embedding" in body) == ("template" in body):
        raise ApiError(
            "validation_failed", "send exactly one of embedding and template, or a photo"
        )
    if "face" in query:
        raise ApiError("validation_failed", "face applies to photos only", {"field": "face"})
    level = one_of(body, query, "level")
    if "embedding" in body:
        embedding = embedding_of(body["embedding"])
        return lambda verifier, stored: verifier.decide_embedding(embedding, stored, level=level)
    template = base64_field(body["template"], "template", code="invalid_template")
    return lambda verifier, stored: verifier.decide_template(template, stored, level=level)


def _decide(runtime: Runtime, caller: Caller, subject: str, decide: Decide) -> Decision:
    # Asked for in either case, so that a subject that does not exist costs no further query.
    epoch = runtime.epoch(caller.tenant)
    contract_id = runtime.contract.contract_id
    found = runtime.store.get(caller.tenant, subject, contract_id=contract_id)
    if found is None:
        if caller.sees_enrollment:
            raise _why_not(runtime, caller.tenant, subject)
        stand_in = runtime.stand_ins.open(caller.tenant, subject)
        return decide(runtime.verifier(caller.tenant, epoch), stand_in)
    return decide(runtime.verifier(caller.tenant, found.record.rotation_epoch), found.wire)


def _why_not(runtime: Runtime, tenant: str, subject: str) -> Exception:
    """Say why there is no template to decide by, to a key that may know who is enrolled."""
    record = runtime.store.describe(tenant, subject)
    if record is None:
        return ApiError("not_enrolled", "the tenant has no such subject")
    try:
        runtime.contract.binding.require_contract(record.contract_id, what="the stored template")
    except ContractMismatch as error:
        return error
    # It was enrolled between the two looks.
    return ApiError("not_enrolled", "the tenant had no such subject a moment ago; send it again")
