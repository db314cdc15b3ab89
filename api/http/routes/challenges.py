"""A challenge of head movements, for one attempt."""

from fastapi import APIRouter, Request

from api.http.bodies import read_json
from api.http.challenges import new_challenge
from api.http.deps import Common, GateDep, RuntimeDep, Verifies
from api.http.openapi import BODY, EVERY_CALL, body_of, error_responses
from api.http.requests import ChallengeJson
from api.http.schemas import ChallengeAnswer
from verify import MAX_FRAMES, MIN_FRAMES

router = APIRouter(prefix="/v1/challenges", tags=["Enroll and verify"])


@router.post(
    "",
    responses=error_responses(*EVERY_CALL, *BODY, "forbidden", "not_found", "replayed"),
    openapi_extra=body_of(json=ChallengeJson),
    summary="Ask for a challenge of head movements",
)
async def create_challenge(
    request: Request, caller: Verifies, runtime: RuntimeDep, gate: GateDep, common: Common
) -> ChallengeAnswer:
    """Right: `verify`. It is good for one verification, of the subject if one is named.

    The frames of a person who makes the movements in this order go to the verification as
    `images`, with the `challenge_id`. It answers alike whether the subject is enrolled or not.

    With a token it is for the token's subject, and answered with the same token; it does not use
    the token up.
    """
    async with gate.admitted(caller.prefix):
        subject = (await read_json(request, runtime.settings, ChallengeJson)).subject_id
    if caller.subject_token is not None:
        caller.subject_token.require("create_challenge", subject)
        subject = caller.subject_token.subject
    runtime.liveness.require_challenges()
    challenge_id, challenge = new_challenge(
        runtime.keyring,
        tenant=caller.tenant,
        key_prefix=caller.prefix,
        subject=subject,
        token=caller.subject_token,
    )
    return ChallengeAnswer(
        **common,
        challenge_id=challenge_id,
        movements=list(challenge.movements),
        min_frames=MIN_FRAMES,
        max_frames=MAX_FRAMES,
        expires_at=challenge.expires_at,
    )
