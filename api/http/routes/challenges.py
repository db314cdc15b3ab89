"""A challenge of head movements, for one attempt."""

from fastapi import APIRouter

from api.http.auth import Verifies
from api.http.bodies import read_json
from api.http.challenges import new_challenge
from api.http.openapi import body_of
from api.http.requests import ChallengeJson
from api.http.schemas import ChallengeAnswer
from verify import MAX_FRAMES, MIN_FRAMES

router = APIRouter(prefix="/v1/challenges", tags=["Enroll and verify"])


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
    challenge_id, challenge = new_challenge(
        call.runtime.keyring,
        tenant=call.tenant,
        key_prefix=call.key.prefix,
        subject=subject,
        token=call.token,
    )
    return ChallengeAnswer(
        **call.common,
        challenge_id=challenge_id,
        movements=list(challenge.movements),
        min_frames=MIN_FRAMES,
        max_frames=MAX_FRAMES,
        expires_at=challenge.expires_at,
    )
