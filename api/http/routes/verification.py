"""Verification: photos, embeddings or a lifted probe against one subject.

The order of a verification, which is what bounds an attacker::

    body and signature read ─▶ locked out, or nonce used? template ─▶ probe, decision
        ─▶ one transaction: nonce used up, lockout checked and counted, audit line ─▶ answer

No decision leaves before that transaction has committed. So of requests that run at the same time
no more are answered than of requests that come one after the other.
"""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from fastapi import APIRouter, Request
from numpy.typing import NDArray
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import Caller
from api.http.bodies import (
    base64_field,
    content_type,
    reject_unknown,
    sent_form,
    sent_json,
    text_field,
)
from api.http.challenges import FIELD as CHALLENGE
from api.http.challenges import MAX_ID, Challenge, opened_challenge
from api.http.deps import GateDep, IdempotencyDep, RuntimeDep, SubjectDep, Verifies, query_of
from api.http.errors import ApiError
from api.http.holder_keys import FIELD, HolderKeyHeaderDep, digest, holder_key_of
from api.http.idempotency import Outcome, once, replay_header
from api.http.openapi import BODY, EVERY_CALL, IDEMPOTENT, PHOTO, VERIFY_BODY, error_responses
from api.http.schemas import VerifyAnswer
from api.http.signatures import FIELDS as SIGNATURE_FIELDS
from api.http.signatures import checked_signature, nonce_in_time
from api.http.values import (
    embedding_of,
    embeddings_of,
    face_policy,
    held_template_of,
    one_of,
)
from api.process.metrics import count_decision, step
from api.process.runtime import Runtime
from api.settings import Settings
from templates.errors import ContractMismatch
from templates.keys.holder_key import wipe
from templates.store.attempts import Attempt
from templates.store.audit_log import By
from templates.store.lockout import Nonce, Superseded
from templates.store.tenants import RetiredRotation
from verify import (
    MAX_FRAMES,
    MAX_PROBE_PHOTOS,
    MIN_FRAMES,
    Decision,
    OpenedTemplate,
    PhotoProbe,
    StandIn,
    Verifier,
)

router = APIRouter(prefix="/v1/subjects", tags=["subjects"])

DECISIONS = 3
"""Times that a probe is decided while others may replace the template before the record; then they
must wait for it."""


PROBES = ("embedding", "embeddings", "template")
"""Fields that hold a probe that is not a photo."""


@dataclass(frozen=True)
class Probe:
    """What is compared, how, with whose template, and what keeps it from a second use.

    `asked` is what tells the request from another one, but for the holder's key.
    """

    kind: Literal["photo", "frames", "embedding", "template"]
    compare: Callable[[Verifier, OpenedTemplate], Decision]
    held_template: bytes | None = field(repr=False)
    nonce: Nonce | None
    holder_key: bytearray | None = field(repr=False)
    asked: tuple[str | bytes, ...] = field(repr=False)


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
    *IDEMPOTENT,
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
    idempotency_key: IdempotencyDep,
) -> Response:
    """Rights: `verify`, and `embeddings` for a probe that is not a photo.

    The probe is 1 to 5 photos, or embeddings, which must show one and the same person and are
    averaged: one comparison, and one attempt. Or it is a private template that the client lifted.

    An enrollment that was made with a holder's key rejects everybody who does not send the same
    `holder_key`, in the same words and time as a wrong face; one that was made without ignores it.

    A level below the lowest that the deployment or the key allows is `forbidden`.

    With a `challenge_id`, the photos are the 5 to 12 frames of a person who makes the movements of
    the challenge. Where the deployment, the level or the key asks for liveness, a probe that does
    not show it is a rejection with the reason `liveness`; one that cannot show it is `forbidden`.

    A subject that does not exist is answered as one that does not match, in the same shape and
    with the same work, and so is one that was enrolled under another contract; only keys with
    `enroll` or `admin` are told `not_enrolled` or `contract_mismatch`. The distance is returned
    only to keys with `scores`, of a rejection where a holder's key is needed only to those that
    have `enroll` or `admin` too: others are told the one that an unknown subject would have.

    Where the subject's holder keeps the template, it comes with the probe as `held_template`. One
    that is missing, altered, replaced or another subject's is a rejection; where the service
    stores the template, it changes nothing.

    A token for this subject may stand in the place of the API key; the decision uses it up. With
    a token an `Idempotency-Key` is taken: the same request gets the same answer once more.
    """
    query = query_of(request, ("level", "face"))
    async with gate.admitted(caller.prefix):
        with step("body"):
            if content_type(request) == "multipart/form-data":
                probe = await _photo_probe(
                    request, runtime, caller, subject, query, holder_key_header
                )
            else:
                probe = await _sent_probe(
                    request, runtime, caller, subject, query, holder_key_header
                )

        def work() -> Outcome:
            decision = _decide_and_wipe(runtime, caller, subject, probe, by(request))
            return Outcome(200, _body(decision, caller))

        outcome = await once(
            request,
            caller,
            # A browser that lost its answer has no other token. An answer to an API key may hold
            # a distance, which is not kept.
            None if caller.subject_token is None else idempotency_key,
            operation="verify",
            asked=[subject, *probe.asked, *digest(probe.holder_key)],
            subject=subject,
            work=work,
            run=partial(gate.compute, key=caller.prefix),
        )
    body = outcome.body
    request.state.log["security_level"] = body["level"]
    request.state.log["decision"] = body["decision"]
    request.state.log["liveness"] = body["liveness"]
    if not outcome.replayed:
        count_decision(
            accepted=body["decision"] == "accept",
            reason=body["reason"],
            level=body["level"],
            probe=probe.kind,
        )
    return answer(request, body, headers=replay_header(outcome))


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
    if "scores" in caller.rights:
        body["distance"] = decision.distance
        if decision.liveness_failure is not None:
            body["liveness_failure"] = str(decision.liveness_failure)
    return body


async def _photo_probe(
    request: Request,
    runtime: Runtime,
    caller: Caller,
    subject: str,
    query: dict[str, str],
    holder_key_header: str | None,
) -> Probe:
    pack = runtime.required_pack()
    settings = runtime.settings
    form = await sent_form(request, settings, max_images=MAX_FRAMES)
    photos = form.images("image", "images")
    reject_unknown(form.fields, ("level", "face", "held_template", CHALLENGE, FIELD))
    challenge_id = text_field(form.fields.get(CHALLENGE), CHALLENGE, max_length=MAX_ID)
    _check_count(len(photos), settings, is_challenge=challenge_id is not None)
    held_template = held_template_of(form.fields)
    level = _level(runtime, caller, one_of(form.fields, query, "level"))
    policy = face_policy(one_of(form.fields, query, "face"))
    holder_key = holder_key_of(holder_key_header, form.fields)

    liveness = runtime.liveness.require(
        level, of_key=caller.liveness, photos=True, challenge=challenge_id is not None
    )
    challenge = None
    if challenge_id is not None:
        challenge = opened_challenge(
            runtime.keyring, challenge_id, tenant=caller.tenant, subject=subject
        )
    nonce = _nonce(caller, challenge)
    embed: Callable[[Verifier], PhotoProbe]
    if challenge is None:

        def embed(verifier: Verifier) -> PhotoProbe:
            return verifier.photo_probe(
                pack, photos, passive=liveness.passive, policy=policy, limits=runtime.image_limits
            )
    else:

        def embed(verifier: Verifier) -> PhotoProbe:
            return verifier.frames_probe(
                pack,
                photos,
                challenge.movements,
                passive=liveness.passive,
                policy=policy,
                limits=runtime.image_limits,
            )

    probes: list[PhotoProbe] = []

    def compare(verifier: Verifier, stored: OpenedTemplate) -> Decision:
        if not probes:  # a probe may be decided more than once
            with step("photo"):
                probes.append(embed(verifier))
        (probe,) = probes
        with step("decide"):
            decision = verifier.decide_embedding(
                probe.embedding, stored, holder_key=holder_key, level=level, photos=probe.photos
            )
        if challenge is None and not liveness.passive:
            return decision
        return decision.with_liveness(probe.failure)

    return Probe(
        "photo" if challenge is None else "frames",
        compare,
        held_template,
        nonce,
        holder_key,
        asked=(level, str(policy), challenge_id or "", held_template or b"", *photos),
    )


def _nonce(caller: Caller, challenge: Challenge | None) -> Nonce | None:
    """Return what a decision on photos uses up.

    Raises
    ------
    ApiError
        ``validation_failed`` where a token comes with a challenge that was not asked for with it.
    """
    token = caller.subject_token
    if token is None:
        return None if challenge is None else challenge.nonce
    if challenge is not None and challenge.nonce.value != token.nonce.value:
        raise ApiError(
            "validation_failed",
            "this challenge was not asked for with this token: ask for one with it",
            {"field": CHALLENGE},
        )
    return token.nonce


def _check_count(count: int, settings: Settings, *, is_challenge: bool) -> None:
    """Refuse more photos than a probe has, or fewer frames than show movements."""
    most = MAX_FRAMES if is_challenge else min(MAX_PROBE_PHOTOS, settings.max_images)
    if count > most:
        raise ApiError("too_many_images", f"at most {most} photos in one request", {"limit": most})
    if is_challenge and count < MIN_FRAMES:
        raise ApiError(
            "validation_failed",
            f"a challenge is answered by {MIN_FRAMES} to {MAX_FRAMES} frames",
            {"field": "images"},
        )


async def _sent_probe(
    request: Request,
    runtime: Runtime,
    caller: Caller,
    subject: str,
    query: dict[str, str],
    holder_key_header: str | None,
) -> Probe:
    caller.require("embeddings")
    settings = runtime.settings
    body = await sent_json(request, settings)
    reject_unknown(body, (*PROBES, "level", "held_template", FIELD, *SIGNATURE_FIELDS))
    named = [kind for kind in PROBES if kind in body]
    if len(named) != 1:
        raise ApiError(
            "validation_failed",
            "send exactly one of embedding, embeddings and template, or photos",
        )
    if "face" in query:
        raise ApiError("validation_failed", "face applies to photos only", {"field": "face"})
    asked = one_of(body, query, "level")
    held_template = held_template_of(body)
    kind, value = named[0], body[named[0]]
    sent: bytes | NDArray[np.float64]
    if kind == "template":
        sent = base64_field(value, "template", code="invalid_template")
    else:
        sent = embedding_of(value) if kind == "embedding" else embeddings_of(value)
    signed = checked_signature(body, sent, key=caller.probe_key, subject_id=subject, level=asked)
    if caller.subject_token is None:
        nonce = nonce_in_time(*signed, key_prefix=caller.prefix, window_s=settings.probe_window_s)
    else:
        # It ends by this clock, and not by that of a browser, and is good once.
        nonce = caller.subject_token.nonce
    level = _level(runtime, caller, asked)
    runtime.liveness.require(level, of_key=caller.liveness, photos=False, challenge=False)
    holder_key = holder_key_of(holder_key_header, body)

    def compare(verifier: Verifier, stored: OpenedTemplate) -> Decision:
        with step("decide"):
            if isinstance(sent, bytes):
                return verifier.decide_template(sent, stored, holder_key=holder_key, level=level)
            rows = np.atleast_2d(sent)
            mean = verifier.average(rows)
            return verifier.decide_embedding(
                mean, stored, holder_key=holder_key, level=level, photos=len(rows)
            )

    return Probe(
        "template" if kind == "template" else "embedding",
        compare,
        held_template,
        nonce,
        holder_key,
        # The HMAC is of all that is signed.
        asked=(body["hmac"], held_template or b""),
    )


def _level(runtime: Runtime, caller: Caller, asked: str | None) -> str:
    if caller.subject_token is not None:
        asked = caller.subject_token.level_of(asked)
    return runtime.levels.in_force(asked, lowest_of_key=caller.lowest_level)


def _decide_and_wipe(
    runtime: Runtime, caller: Caller, subject: str, probe: Probe, who: By
) -> Decision:
    """Decide, and forget the holder's key: here, because nobody waits for a cancelled thread."""
    try:
        return _decide_and_record(runtime, caller, subject, probe, who)
    finally:
        wipe(probe.holder_key)


def _decide_and_record(
    runtime: Runtime, caller: Caller, subject: str, probe: Probe, who: By
) -> Decision:
    """Decide and record; a template that was replaced or erased meanwhile accepts nobody."""
    attempts, contract_ids = runtime.store.attempts, runtime.contract.binding.contract_ids

    def compare(attempt: Attempt) -> Decision:
        return _decided(probe, _opened(runtime, caller, subject, attempt))

    for _ in range(DECISIONS):
        # A retired rotation: the template was moved into a newer epoch between the two looks.
        with contextlib.suppress(Superseded, RetiredRotation):
            # In one step, which metrics show: it must not tell who is enrolled.
            with step("store"):
                attempt = attempts.begin(
                    caller.tenant,
                    subject,
                    contract_ids=contract_ids,
                    nonce=probe.nonce,
                    held_template=probe.held_template,
                )
                opened = _opened(runtime, caller, subject, attempt)
            decision = _decided(probe, opened)
            with step("record"):
                attempts.conclude(
                    caller.tenant,
                    subject,
                    accepted=decision.accepted,
                    template_id=attempt.template_id,
                    contract_ids=contract_ids,
                    level=decision.level,
                    nonce=probe.nonce,
                    by=who,
                )
            return decision
    return attempts.decide_alone(
        caller.tenant,
        subject,
        compare,
        contract_ids=contract_ids,
        nonce=probe.nonce,
        held_template=probe.held_template,
        by=who,
    )


@dataclass(frozen=True)
class _Opened:
    """What compares, and with what.

    `nobody` is the subject's stand-in where the caller is told distances and not who is enrolled.
    """

    verifier: Verifier
    stored: OpenedTemplate
    nobody: StandIn | None


def _decided(probe: Probe, opened: _Opened) -> Decision:
    decision = probe.compare(opened.verifier, opened.stored)
    if opened.nobody is None:
        return decision
    # A wrong holder's key turns the probe away from all faces: the distance would tell that a key
    # is needed, and so that somebody is enrolled. Compared for every subject: the time tells.
    unknown = probe.compare(opened.verifier, opened.nobody)
    if decision.accepted or opened.stored.holder_salt is None:
        return decision
    return replace(decision, distance=unknown.distance)


def _opened(runtime: Runtime, caller: Caller, subject: str, attempt: Attempt) -> _Opened:
    """Open the subject's template, or one of nobody."""
    template, tenant = attempt.template, caller.tenant
    lifted = None
    if "scores" in caller.rights and not caller.sees_enrollment:
        # The distance will be told. Lifted for every subject, enrolled or not: the time tells.
        lifted = runtime.stand_ins.lift(tenant, subject)
    if attempt.untried is not None:
        # Opened for every subject, as one whose holder keeps a template: the time tells.
        runtime.stand_ins.open_in_vain(attempt.untried)
    stored: OpenedTemplate
    if template is not None:
        stored, epoch = template, template.record.rotation_epoch
    elif caller.sees_enrollment and attempt.template_id is None:
        raise _why_not(runtime, tenant, subject)
    else:
        stored, epoch = runtime.stand_ins.open(lifted), attempt.rotation_epoch
    nobody = None if lifted is None else StandIn(stored.wire, lifted)
    return _Opened(runtime.verifier(tenant, epoch), stored, nobody)


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
