"""Verification: photos, embeddings or a lifted probe against one subject.

The order of a verification, which is what bounds an attacker::

    body read ─▶ locked out, or token used? template ─▶ probe, decision
        ─▶ one write: token used up, lockout checked and counted, audit line ─▶ answer

No decision leaves before that write has committed. So of requests that run at the same time
no more are answered than of requests that come one after the other.
"""

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import Caller
from api.http.deps import GateDep, RuntimeDep, SubjectDep, Verifies
from api.http.errors import ApiError
from api.http.holder_keys import HolderKeyHeaderDep, wiping
from api.http.openapi import BODY, EVERY_CALL, PHOTO, VERIFY_BODY, error_responses
from api.http.probes import Probe, sent_probe
from api.http.schemas import VerifyAnswer
from api.service.metrics import count_decision, step
from api.service.runtime import Runtime
from templates.errors import ContractMismatch
from templates.store.attempts import Attempt
from templates.store.audit_log import By
from verify import Decision

router = APIRouter(prefix="/v1/subjects", tags=["Enroll and verify"])

CODES = (
    *EVERY_CALL,
    *BODY,
    *PHOTO,
    "forbidden",
    "not_enrolled",
    "invalid_template",
    "invalid_embedding",
    "inconsistent_images",
    "contract_mismatch",
    "uncalibrated",
    "replayed",
    "locked_out",
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
    request: Request,
    caller: Verifies,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    holder_key_header: HolderKeyHeaderDep,
) -> Response:
    """Rights: `verify`, and `embeddings` for a probe that is not a photo.

    The probe is 1 to 5 photos, or embeddings, which must show one and the same person and are
    averaged: one comparison, and one attempt. Or it is a private template that the client lifted.

    An enrollment that was made with a holder's key rejects everybody who does not send the same
    `holder_key`, in the same words and time as a wrong face; one that was made without ignores it.

    A level below the lowest that the deployment or the key allows is `forbidden`.

    With a `challenge_id`, the photos are the 5 to 12 frames of a person who makes the movements of
    the challenge. Where the deployment asks for liveness, a probe that does not show it
    is a rejection with the reason `liveness`; one that cannot show it is `forbidden`.

    A subject that does not exist is answered as one that does not match, in the same shape and
    with the same work, and so is one that was enrolled under another contract; only keys with
    `enroll` or `admin` are told `not_enrolled` or `contract_mismatch`. The distance is returned
    only to keys with `scores` and `enroll`.

    A token for this subject may stand in the place of the API key; the decision uses it up.
    """
    async with gate.admitted(caller.prefix):
        with step("body"):
            probe = await sent_probe(request, runtime, caller, subject, holder_key_header)

        def work() -> Decision:
            if caller.subject_token is not None:
                # Once more: the body and the turn to compute may have taken a while.
                caller.subject_token.require_in_time()
            return _decide(runtime, caller, subject, probe, by(request))

        decision = await gate.compute(wiping(probe.holder_key, work), key=caller.prefix)
    body = _body(decision, caller)
    request.state.log["security_level"] = body["level"]
    request.state.log["decision"] = body["decision"]
    request.state.log["liveness"] = body["liveness"]
    count_decision(
        accepted=decision.accepted, reason=decision.reason, level=decision.level, probe=probe.kind
    )
    return answer(request, body)


def _body(decision: Decision, caller: Caller) -> dict[str, Any]:
    body: dict[str, Any] = {
        "decision": "accept" if decision.accepted else "reject",
        "reason": decision.reason,
        "liveness": decision.liveness,
        "level": decision.level,
        "fmr": decision.fmr,
        "contract_id": decision.contract_id,
        "calibration_id": decision.calibration_id,
    }
    if {"scores", "enroll"} <= caller.rights:
        body["distance"] = decision.distance
        if decision.liveness_failure is not None:
            body["liveness_failure"] = str(decision.liveness_failure)
    if decision.advice is not None:
        body["advice"] = decision.advice
    return body


def _decide(runtime: Runtime, caller: Caller, subject: str, probe: Probe, who: By) -> Decision:
    """Decide and record; a subject that is not enrolled costs what an enrolled one does."""

    def compare(attempt: Attempt) -> Decision:
        template = attempt.template
        if template is not None:
            verifier = runtime.verifier(caller.tenant, template.record.rotation_epoch)
            return probe.compare(verifier, template)
        if caller.sees_enrollment:
            raise _why_not(runtime, caller.tenant, subject)
        verifier = runtime.verifier(caller.tenant, attempt.rotation_epoch)
        return probe.compare(verifier, runtime.stand_in.open())

    return runtime.store.attempts.decide(
        caller.tenant,
        subject,
        compare,
        contract_id=runtime.contract.contract_id,
        token=probe.token,
        by=who,
    )


def _why_not(runtime: Runtime, tenant: str, subject: str) -> Exception:
    """Say why there is no template to decide by, to a key that may know who is enrolled."""
    record = runtime.store.subjects.describe(tenant, subject)
    if record is None:
        return ApiError("not_enrolled", "nobody is enrolled under this id")
    try:
        runtime.contract.binding.require_contract(record.contract_id, what="the stored template")
    except ContractMismatch as error:
        return error
    # It was enrolled between the two looks.
    return ApiError("not_enrolled", "nobody was enrolled under this id a moment ago; send it again")
