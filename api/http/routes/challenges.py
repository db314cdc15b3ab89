"""A challenge of head movements, for one attempt.

Its id is sealed and self-contained, so that any worker knows it and nothing is stored of it. The
decision uses it up, in the decision's transaction.
"""

import secrets

from fastapi import APIRouter

from api.http.auth import Call, Verifies
from api.http.bodies import read_json
from api.http.errors import ApiError
from api.http.openapi import body_of
from api.http.requests import ChallengeJson
from api.http.schemas import ChallengeAnswer
from api.http.tokens import Sealed, ends_in, opened
from templates.store.audit_log import token_digest
from verify import MAX_FRAMES, MIN_FRAMES, Movement, draw_movements

LIFETIME_S = 60
_PURPOSE = "challenge"
router = APIRouter(prefix="/v1/challenges", tags=["Enroll and verify"])


class Challenge(Sealed):
    """What was asked, and what keeps it from a second use.

    ``subject`` is the only one that it can be answered for, None for any. ``digest`` is what the
    decision uses up: the token's own, where a token asked for the challenge (``is_of_token``).
    """

    subject: str | None
    movements: tuple[Movement, ...]
    digest: str
    is_of_token: bool


@router.post(
    "",
    openapi_extra=body_of(json=ChallengeJson),
    summary="Ask for a challenge of head movements",
)
async def create_challenge(call: Verifies) -> ChallengeAnswer:
    """Right: `verify`. It is good for one verification, of the subject if one is named.

    The frames of a person who makes the movements in this order go to the verification as
    `images`, with the `challenge_id`. It answers alike whether the subject is enrolled or not.

    With a token it is for the token's subject, and answered with the same token; it does not use
    the token up.
    """
    async with call.place():
        sent = await read_json(call.request, ChallengeJson)
    subject = sent.subject_id
    if call.token is not None:
        call.token.require("create_challenge", subject)
        subject = call.token.subject
    call.runtime.liveness.require_challenges()
    expires, digest = ends_in(LIFETIME_S), token_digest(call.key.prefix, secrets.token_urlsafe(18))
    if call.token is not None:
        # One decision uses up both, so the challenge ends no later than the token.
        expires, digest = min(expires, call.token.expires_at), call.token.digest
    challenge = Challenge(
        expires_at=expires,
        subject=subject,
        movements=draw_movements(),
        digest=digest,
        is_of_token=call.token is not None,
    )
    return ChallengeAnswer(
        challenge_id=challenge.sealed(call.runtime.keyring, _PURPOSE, [call.tenant]),
        movements=list(challenge.movements),
        min_frames=MIN_FRAMES,
        max_frames=MAX_FRAMES,
        expires_at=challenge.expires_at,
    )


def opened_challenge(call: Call, challenge_id: str, subject: str) -> Challenge:
    """Open the id of a challenge that frames answer.

    One that was asked for with a token comes with it: a decision under an API key, at whatever
    level it asks for, must not be taken for the token's.
    """
    challenge = opened(Challenge, challenge_id, call.runtime.keyring, _PURPOSE, [call.tenant])
    if challenge is None or challenge.subject not in (None, subject):
        raise ApiError(
            "validation_failed",
            "the challenge_id is not one that this service gave out for this tenant and subject",
            {"field": "challenge_id"},
        )
    challenge.require_in_time()
    own = None if call.token is None else call.token.digest
    if own != (challenge.digest if challenge.is_of_token else None):
        raise ApiError(
            "validation_failed",
            "a challenge is answered with the token that it was asked for with, and one of an API "
            "key with an API key: ask for one with what you send",
            {"field": "challenge_id"},
        )
    return challenge
