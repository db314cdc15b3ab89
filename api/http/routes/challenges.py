"""A challenge of head movements, for one attempt."""

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.bodies import sent_json, text_field
from api.http.challenges import new_challenge
from api.http.deps import GateDep, RuntimeDep, Verifies
from api.http.openapi import BODY, CHALLENGE_BODY, EVERY_CALL, error_responses
from api.http.schemas import ChallengeAnswer
from api.http.values import iso_time
from templates.store.identifiers import checked_subject_id
from verify import MAX_FRAMES, MIN_FRAMES

router = APIRouter(prefix="/v1/challenges", tags=["Enroll and verify"])


@router.post(
    "",
    response_model=ChallengeAnswer,
    responses=error_responses(*EVERY_CALL, *BODY, "forbidden", "not_found", "replayed"),
    openapi_extra=CHALLENGE_BODY,
    summary="Ask for a challenge of head movements",
)
async def create_challenge(
    request: Request, caller: Verifies, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Right: `verify`. It is good for one verification, of the subject if one is named.

    The frames of a person who makes the movements in this order go to the verification as
    `images`, with the `challenge_id`. It answers alike whether the subject is enrolled or not.

    With a token it is for the token's subject, and answered with the same token; it does not use
    the token up.
    """
    async with gate.admitted(caller.prefix):
        body = await sent_json(request, runtime.settings, ("subject_id",))
    subject = text_field(body.get("subject_id"), "subject_id", max_length=128)
    if subject is not None:
        checked_subject_id(subject)
    token = caller.subject_token
    if token is not None:
        token.require_subject(subject)
        subject = token.subject
    runtime.liveness.require_challenges()
    challenge_id, challenge = new_challenge(
        runtime.keyring,
        tenant=caller.tenant,
        key_prefix=caller.prefix,
        subject=subject,
        token=token,
    )
    return answer(
        request,
        {
            "challenge_id": challenge_id,
            "movements": [str(movement) for movement in challenge.movements],
            "min_frames": MIN_FRAMES,
            "max_frames": MAX_FRAMES,
            "expires_at": iso_time(challenge.expires_at),
        },
    )
