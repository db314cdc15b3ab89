"""Verification: a photo, an embedding or a lifted probe against one subject.

The order of a verification, which is what bounds an attacker::

    body and signature read ─▶ locked out, or nonce used? template ─▶ probe, decision
        ─▶ one transaction: nonce used up, lockout checked and counted, audit line ─▶ answer

No decision leaves before that transaction has committed. So of requests that run at the same time
no more are answered than of requests that come one after the other.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from fastapi import APIRouter, Request
from numpy.typing import NDArray
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import Caller
from api.http.bodies import base64_field, content_type, reject_unknown, sent_form, sent_json
from api.http.deps import GateDep, RuntimeDep, SubjectDep, Verifies, query_of
from api.http.errors import ApiError
from api.http.openapi import BODY, EVERY_CALL, PHOTO, VERIFY_BODY, error_responses
from api.http.schemas import VerifyAnswer
from api.http.signatures import FIELDS as SIGNATURE_FIELDS
from api.http.signatures import checked_nonce
from api.http.values import embedding_of, face_policy, one_of
from api.process.metrics import count_decision, step
from api.process.runtime import Runtime
from templates.errors import ContractMismatch
from templates.store.attempts import Attempt
from templates.store.audit_log import By
from templates.store.lockout import Nonce, Superseded
from templates.store.tenants import RetiredRotation
from verify import Decision, StandIn, Verifier

router = APIRouter(prefix="/v1/subjects", tags=["subjects"])

DECISIONS = 3
"""Times that a probe is decided while others may replace the template before the record; then they
must wait for it."""


@dataclass(frozen=True)
class Probe:
    """What is compared, how, and what keeps it from a second use."""

    kind: str
    compare: Callable[[Verifier, bytes | StandIn], Decision]
    nonce: Nonce | None


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
    """Rights: `verify`, and `embeddings` for a probe that is not a photo.

    A level below the lowest that the deployment or the key allows is `forbidden`.

    A subject that does not exist is answered as one that does not match, in the same shape and
    with the same work, and so is one that was enrolled under another contract; only keys with
    `enroll` or `admin` are told `not_enrolled` or `contract_mismatch`. The distance is returned
    only to keys with `scores`.
    """
    query = query_of(request, ("level", "face"))
    async with gate.admitted(caller.prefix):
        with step("body"):
            if content_type(request) == "multipart/form-data":
                probe = await _photo_probe(request, runtime, caller, query)
            else:
                probe = await _sent_probe(request, runtime, caller, subject, query)
        decision = await gate.compute(
            partial(_decide_and_record, runtime, caller, subject, probe, by(request)),
            key=caller.prefix,
        )
    request.state.log["security_level"] = decision.level
    request.state.log["decision"] = "accept" if decision.accepted else "reject"
    count_decision(accepted=decision.accepted, level=decision.level, probe=probe.kind)
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


async def _photo_probe(
    request: Request, runtime: Runtime, caller: Caller, query: dict[str, str]
) -> Probe:
    pack = runtime.required_pack()
    settings = runtime.settings
    form = await sent_form(request, settings, max_images=1)
    photo = form.images("image")[0]
    reject_unknown(form.fields, ("level", "face"))
    level = _level(runtime, caller, one_of(form.fields, query, "level"))
    policy = face_policy(one_of(form.fields, query, "face"))

    embedded: list[NDArray[np.float32]] = []

    def compare(verifier: Verifier, stored: bytes | StandIn) -> Decision:
        if not embedded:  # a probe may be decided more than once
            with step("photo"):
                embedded.append(
                    verifier.embed_photo(pack, photo, policy=policy, limits=runtime.image_limits)
                )
        with step("decide"):
            return verifier.decide_embedding(embedded[0], stored, level=level)

    return Probe("photo", compare, nonce=None)


async def _sent_probe(
    request: Request, runtime: Runtime, caller: Caller, subject: str, query: dict[str, str]
) -> Probe:
    caller.require("embeddings")
    settings = runtime.settings
    body = await sent_json(request, settings)
    reject_unknown(body, ("embedding", "template", "level", *SIGNATURE_FIELDS))
    if ("embedding" in body) == ("template" in body):
        raise ApiError(
            "validation_failed", "send exactly one of embedding and template, or a photo"
        )
    if "face" in query:
        raise ApiError("validation_failed", "face applies to photos only", {"field": "face"})
    asked = one_of(body, query, "level")
    sent: bytes | NDArray[np.float64]
    if "embedding" in body:
        kind, sent = "embedding", embedding_of(body["embedding"])
    else:
        kind, sent = "template", base64_field(body["template"], "template", code="invalid_template")
    nonce = checked_nonce(
        body,
        sent,
        key=caller.probe_key,
        key_prefix=caller.prefix,
        subject_id=subject,
        level=asked,
        window_s=settings.probe_window_s,
    )
    level = _level(runtime, caller, asked)

    def compare(verifier: Verifier, stored: bytes | StandIn) -> Decision:
        with step("decide"):
            if isinstance(sent, bytes):
                return verifier.decide_template(sent, stored, level=level)
            return verifier.decide_embedding(sent, stored, level=level)

    return Probe(kind, compare, nonce)


def _level(runtime: Runtime, caller: Caller, asked: str | None) -> str:
    return runtime.levels.in_force(asked, lowest_of_key=caller.lowest_level)


def _decide_and_record(
    runtime: Runtime, caller: Caller, subject: str, probe: Probe, who: By
) -> Decision:
    """Decide and record; a template that was replaced or erased meanwhile accepts nobody."""
    attempts, contract_id = runtime.store.attempts, runtime.contract.contract_id

    def compare(attempt: Attempt) -> Decision:
        return probe.compare(*_verifier_and_template(runtime, caller, subject, attempt))

    for _ in range(DECISIONS):
        # A retired rotation: the template was turned into a newer one between the two looks.
        with contextlib.suppress(Superseded, RetiredRotation):
            # In one step, which metrics show: it must not tell who is enrolled.
            with step("store"):
                attempt = attempts.begin(
                    caller.tenant, subject, contract_id=contract_id, nonce=probe.nonce
                )
                verifier, stored = _verifier_and_template(runtime, caller, subject, attempt)
            decision = probe.compare(verifier, stored)
            with step("record"):
                attempts.conclude(
                    caller.tenant,
                    subject,
                    accepted=decision.accepted,
                    template_id=attempt.template_id,
                    contract_id=contract_id,
                    level=decision.level,
                    nonce=probe.nonce,
                    by=who,
                )
            return decision
    return attempts.decide_alone(
        caller.tenant, subject, compare, contract_id=contract_id, nonce=probe.nonce, by=who
    )


def _verifier_and_template(
    runtime: Runtime, caller: Caller, subject: str, attempt: Attempt
) -> tuple[Verifier, bytes | StandIn]:
    """Return what compares with the subject's template, and that template, or one of nobody."""
    template, tenant = attempt.template, caller.tenant
    lifted = None
    if "scores" in caller.rights and not caller.sees_enrollment:
        # The distance will be told. Lifted for every subject, enrolled or not: the time tells.
        lifted = runtime.stand_ins.lift(tenant, subject)
    if template is not None:
        return runtime.verifier(tenant, template.record.rotation_epoch), template.wire
    if caller.sees_enrollment:
        raise _why_not(runtime, tenant, subject)
    verifier = runtime.verifier(tenant, attempt.rotation_epoch)
    return verifier, runtime.stand_ins.open(lifted)


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
