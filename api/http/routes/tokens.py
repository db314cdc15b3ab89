"""Tokens for browsers: made for one call of one subject, and what came of them."""

from typing import Annotated, Any

from fastapi import APIRouter, Path

from api.http.auth import AnyCall, EnrollsOrVerifies
from api.http.bodies import read_json
from api.http.deps import SubjectDep
from api.http.openapi import body_of
from api.http.requests import TokenJson
from api.http.schemas import TokenAnswer, TokenOutcomeAnswer
from api.http.tokens import SubjectToken, ends_in
from api.service.metrics import TOKENS
from templates.store.audit_log import Entry, token_digest

router = APIRouter(prefix="/v1", tags=["Tokens"])


@router.post(
    "/tokens",
    status_code=201,
    openapi_extra=body_of(json=TokenJson),
    summary="Make a token for a browser",
)
async def create_token(call: AnyCall) -> TokenAnswer:
    """Right: `verify` or `enroll`, as the action. For one call of one subject, within two minutes.

    A browser holds it in place of an API key: it is good for one decision at one level, or for one
    enrollment, and for what a client needs before: a challenge, the contract, the generator, the
    pack. With `"replace": false` its enrollment replaces nobody. It answers alike whether the
    subject is enrolled or not. Ask with its `token_id` what came of it; never believe the page.
    """
    runtime = call.runtime
    async with call.place():
        asked = await read_json(call.request, TokenJson)
    pseudonym = call.note_subject(asked.subject_id)
    call.require(asked.action)
    level = None
    if asked.action == "verify":
        level = runtime.levels.in_force(asked.level, lowest_of_key=call.key.lowest_level)
    token = SubjectToken(
        subject=asked.subject_id,
        action=asked.action,
        level=level,
        key_prefix=call.key.prefix,
        replace=asked.replace,
        expires_at=ends_in(asked.lifetime_s),
    )
    detail = f"{token.action} {token.token_id}"
    entry = Entry("token", "issued", call.by, call.tenant, pseudonym, detail)
    await call.query(lambda: call.store.audit_log.record(entry))
    call.request.state.log["token_id"] = token.token_id
    TOKENS.labels(token.action).inc()
    return TokenAnswer(
        token=token.text(runtime.keyring, key_id=call.key.id),
        token_id=token.token_id,
        subject_id=token.subject,
        action=token.action,
        level=level,
        expires_at=token.expires_at,
    )


@router.get("/subjects/{subject_id}/tokens/{token_id}", summary="What came of a token")
async def get_token_outcome(
    call: EnrollsOrVerifies,
    subject: SubjectDep,
    token_id: Annotated[
        str,
        Path(
            description="`token_id` of POST /v1/tokens.",
            min_length=1,
            max_length=64,
            examples=["pX3q0u5mC1oV8n2JdE7yRw4k"],
        ),
    ],
) -> TokenOutcomeAnswer:
    """Right: `verify` or `enroll`, and the API key that asked for the token.

    For a token that another key asked for, of another subject, or that nobody asked for, it
    answers what it answers for one that was not used.
    """
    digest = token_digest(call.key.prefix, token_id)
    line = await call.query(lambda: call.store.audit_log.use_of(digest))
    if line is None or line.pseudonym != call.note_subject(subject):
        return TokenOutcomeAnswer(
            token_id=token_id, used=False, outcome=None, level=None, used_at=None
        )
    outcome: Any = line.outcome
    return TokenOutcomeAnswer(
        token_id=token_id,
        used=True,
        outcome=outcome,
        level=line.detail if line.action == "verify" else None,
        used_at=line.at,
    )
