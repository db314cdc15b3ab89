"""Tokens for browsers: made for one call of one subject, and what came of them."""

from typing import Annotated

from fastapi import APIRouter, Path, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.audit import by
from api.http.auth import CallerDep, note_subject
from api.http.bodies import sent_json, text_field
from api.http.deps import EnrollsOrVerifies, GateDep, RuntimeDep, SubjectDep
from api.http.errors import ApiError
from api.http.openapi import BODY, EVERY_CALL, TOKEN_BODY, error_responses
from api.http.schemas import TokenAnswer, TokenOutcomeAnswer
from api.http.tokens import ACTIONS, LONGEST_S, new_token
from api.http.values import iso_time
from api.service.metrics import TOKENS
from templates.store.audit_log import Entry, token_digest
from templates.store.identifiers import checked_subject_id

FIELDS = ("subject_id", "action", "level", "lifetime_s", "replace")

router = APIRouter(prefix="/v1", tags=["Tokens"])


@router.post(
    "/tokens",
    status_code=201,
    response_model=TokenAnswer,
    responses=error_responses(*EVERY_CALL, *BODY, "forbidden", "uncalibrated"),
    openapi_extra=TOKEN_BODY,
    summary="Make a token for a browser",
)
async def create_token(
    request: Request, caller: CallerDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `verify` or `enroll`, as the action. For one call of one subject, within two minutes.

    A browser holds it in place of an API key: it is good for one decision at one level, or for one
    enrollment, and for what a client needs before: a challenge, the contract, the generator, the
    pack. With `"replace": false` its enrollment replaces nobody. It answers alike whether the
    subject is enrolled or not. Ask with its `token_id` what came of it; never believe the page.
    """
    async with gate.admitted(caller.prefix):
        body = await sent_json(request, runtime.settings, FIELDS)
    subject = text_field(body.get("subject_id"), "subject_id", max_length=128)
    if subject is None:
        raise _wrong("subject_id", "subject_id must be there")
    checked_subject_id(subject)
    pseudonym = runtime.store.signer.pseudonym(caller.tenant, subject)
    note_subject(request, pseudonym)
    action = next((known for known in ACTIONS if known == body.get("action")), None)
    if action is None:
        raise _wrong("action", "action must be verify or enroll")
    caller.require(action)
    level = text_field(body.get("level"), "level")
    if action == "verify":
        level = runtime.levels.in_force(level, lowest_of_key=caller.lowest_level)
        runtime.levels.require_known(level)
    elif level is not None:
        raise _wrong("level", "a level is for the action verify only")
    lifetime_s = body.get("lifetime_s", LONGEST_S)
    if type(lifetime_s) is not int or not 1 <= lifetime_s <= LONGEST_S:
        raise _wrong("lifetime_s", f"lifetime_s must be whole seconds, 1 to {LONGEST_S}")
    replace = body.get("replace", True)
    if type(replace) is not bool or (action == "verify" and "replace" in body):
        raise _wrong("replace", "replace is true or false, and for the action enroll only")
    made = new_token(
        runtime.keyring,
        key_id=caller.key_id,
        key_prefix=caller.prefix,
        subject=subject,
        action=action,
        level=level,
        lifetime_s=lifetime_s,
        replace=replace,
    )
    token = made.token
    entry = Entry(
        "token", "issued", by(request), caller.tenant, pseudonym, f"{action} {token.token_id}"
    )
    await gate.query(lambda: runtime.store.audit_log.record(entry))
    request.state.log["token_id"] = token.token_id
    TOKENS.labels(action).inc()
    return answer(
        request,
        {
            "token": made.text,
            "token_id": token.token_id,
            "subject_id": subject,
            "action": action,
            "level": level,
            "expires_at": iso_time(token.expires_at),
        },
        status=201,
    )


@router.get(
    "/subjects/{subject_id}/tokens/{token_id}",
    response_model=TokenOutcomeAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "validation_failed"),
    summary="What came of a token",
)
async def get_token_outcome(
    request: Request,
    caller: EnrollsOrVerifies,
    subject: SubjectDep,
    runtime: RuntimeDep,
    gate: GateDep,
    token_id: Annotated[
        str,
        Path(
            description="`token_id` of POST /v1/tokens.",
            min_length=1,
            max_length=64,
            examples=["pX3q0u5mC1oV8n2JdE7yRw4k"],
        ),
    ],
) -> Response:
    """Right: `verify` or `enroll`, and the API key that asked for the token.

    For a token that another key asked for, of another subject, or that nobody asked for, it
    answers what it answers for one that was not used.
    """
    pseudonym = runtime.store.signer.pseudonym(caller.tenant, subject)
    digest = token_digest(caller.prefix, token_id)
    line = await gate.query(lambda: runtime.store.audit_log.use_of(digest))
    if line is None or line.pseudonym != pseudonym:
        line = None
    return answer(
        request,
        {
            "token_id": token_id,
            "used": line is not None,
            "outcome": None if line is None else line.outcome,
            "level": line.detail if line is not None and line.action == "verify" else None,
            "used_at": None if line is None else iso_time(line.at),
        },
    )


def _wrong(field: str, message: str) -> ApiError:
    return ApiError("validation_failed", message, {"field": field})
