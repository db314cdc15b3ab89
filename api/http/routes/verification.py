"""Verification: photos, embeddings or a lifted probe against one subject.

The order of a verification, which is what bounds an attacker::

    body read ─▶ level, liveness ─▶ one read: used? locked out? template ─▶ probe ─▶ decision
        ─▶ one write: token used up, lockout checked and counted, audit line ─▶ answer

A locked subject's photo is not looked at. The lock is read first, and a subject id is locked
whether or not somebody is enrolled under it. A template, or the stand-in, is opened before the
photo is looked at, so that the time of a refused photo does not tell the two apart either.

:meth:`templates.store.attempts.Attempts.decide` reads and writes; between the two it calls the
``compare`` of :func:`_decide`. What runs before the route is not in its signature: unknown names
are refused (``api.http.deps``), the key is recognised and counted, and its right asked for
(``api.http.auth``).

No decision leaves before that write has committed. So of requests that run at the same time
no more are answered than of requests that come one after the other.
"""

from collections.abc import Callable
from functools import cache, partial

from fastapi import APIRouter

from api.http.auth import Call, Verifies
from api.http.bodies import is_form, read_form, read_json
from api.http.deps import SubjectDep
from api.http.errors import ApiError
from api.http.openapi import body_of
from api.http.requests import VerifyForm, VerifyJson
from api.http.routes.challenges import Challenge, opened_challenge
from api.http.schemas import VerifyAnswer
from api.service.metrics import DECISIONS, step
from api.service.runtime import Runtime
from templates.keys.holder_key import wipe
from templates.store.attempts import Attempt
from verify import (
    MAX_FRAMES,
    Decision,
    PhotoProbe,
    probe_of_embeddings,
    probe_of_frames,
    probe_of_photos,
)

router = APIRouter(prefix="/v1/subjects", tags=["Enroll and verify"])


@router.post(
    "/{subject_id}/verify",
    openapi_extra=body_of(form=VerifyForm, json=VerifyJson),
    summary="Is this the subject?",
)
async def verify(call: Verifies, subject: SubjectDep) -> VerifyAnswer:
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
    runtime, token = call.runtime, call.token
    async with call.place():
        with step("body"):
            sent = await _sent(call)
        asked = sent.level if token is None else token.level_of(sent.level)
        level = runtime.levels.in_force(asked, lowest_of_key=call.key.lowest_level)
        challenge = None
        if sent.challenge_id is not None:
            challenge = opened_challenge(call, sent.challenge_id, subject)

        def work() -> Decision:
            try:
                return _decide(call, subject, sent, level, challenge)
            finally:
                wipe(sent.holder_key)

        decision = await call.compute(work)
    return answer_of(call, decision, probe=sent.kind)


def answer_of(call: Call, decision: Decision, *, probe: str) -> VerifyAnswer:
    """Return the answer, with what the caller may see; note it for the log and the metrics."""
    answer = VerifyAnswer(
        decision="accept" if decision.accepted else "reject",
        reason=decision.reason,
        liveness=decision.liveness,
        level=decision.level,
        fmr=decision.fmr,
        contract_id=decision.contract_id,
        calibration_id=decision.calibration_id,
        distance=decision.distance if call.sees_scores else None,
        distance_threshold=decision.distance_threshold if call.sees_scores else None,
        liveness_failure=decision.liveness_failure if call.sees_scores else None,
        advice=decision.advice,
    )
    call.request.state.log.update(
        security_level=decision.level, decision=answer.decision, liveness=answer.liveness
    )
    DECISIONS.labels(answer.decision, answer.reason, answer.level, probe).inc()
    return answer


async def _sent(call: Call) -> VerifyForm | VerifyJson:
    """Read the probe, and refuse what can be refused without decoding anything."""
    request, runtime = call.request, call.runtime
    if not is_form(request):
        sent = await read_json(request, VerifyJson, photos="image")
        # After the fields: a caller who only sent the photo wrongly is told so first, not that a
        # right is missing.
        call.require("embeddings")
        runtime.liveness.require(photos=False, challenge=False)
        return sent
    runtime.required_pack()
    form = await read_form(request, VerifyForm, photos="image", most=MAX_FRAMES)
    runtime.liveness.require(photos=True, challenge=form.challenge_id is not None)
    return form


def _decide(
    call: Call,
    subject: str,
    sent: VerifyForm | VerifyJson,
    level: str,
    challenge: Challenge | None,
) -> Decision:
    """Make the probe, decide, and record; a subject that is not enrolled costs what others do."""
    runtime = call.runtime
    if call.token is not None:
        # Once more: the body and the turn to compute may have taken a while.
        call.token.require_in_time()
    # Once, however often the template is replaced meanwhile.
    probe_of = cache(partial(_probe, runtime, sent, challenge))
    live = challenge is not None or runtime.liveness.policy.passive
    spent = challenge or call.token

    def compare(attempt: Attempt) -> Decision:
        template, epoch = attempt.template, attempt.rotation_epoch
        if template is not None:
            epoch = template.record.rotation_epoch
        elif call.sees_enrollment:
            raise _why_not(runtime, call.tenant, subject)
        stored = template or runtime.stand_in.open()
        probe = probe_of()
        verifier = runtime.epoch(call.tenant, epoch).verifier
        with step("decide"):
            if isinstance(probe, bytes):
                return verifier.decide_template(
                    probe, stored, holder_key=sent.holder_key, level=level
                )
            decision = verifier.decide_embedding(
                probe.embedding,
                stored,
                holder_key=sent.holder_key,
                level=level,
                photos=probe.photos,
            )
        if live:
            decision = decision.with_liveness(probe.failure)
        return decision.with_advice(clear=probe.clear)

    return runtime.store.attempts.decide(
        call.tenant,
        subject,
        compare,
        contract_id=runtime.contract.contract_id,
        token=None if spent is None else spent.digest,
        by=call.by,
    )


def _probe(
    runtime: Runtime, sent: VerifyForm | VerifyJson, challenge: Challenge | None
) -> PhotoProbe | bytes:
    """Embed photos, hold frames against their challenge, or average embeddings.

    A lifted probe is returned as its wire bytes.
    """
    contract = runtime.contract
    if isinstance(sent, VerifyJson):
        lifted = sent.template
        return probe_of_embeddings(contract, sent.rows) if lifted is None else lifted
    make: Callable[..., PhotoProbe] = probe_of_photos
    if challenge is not None:
        make = partial(probe_of_frames, movements=challenge.movements)
    with step("photo"):
        return make(
            runtime.required_pack(),
            contract,
            sent.photos,
            passive=runtime.liveness.policy.passive,
            policy=sent.face,
        )


def _why_not(runtime: Runtime, tenant: str, subject: str) -> Exception:
    """Say why there is no template to decide by, to a key that may know who is enrolled."""
    record = runtime.store.subjects.describe(tenant, subject)
    if record is not None:
        binding = runtime.contract.binding
        binding.require_contract(record.contract_id, what="the stored template")
    return ApiError("not_enrolled", "nobody is enrolled under this id")
