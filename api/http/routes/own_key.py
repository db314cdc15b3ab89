"""What the caller's own API key is: for clients that show what they may do."""

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.http.answers import answer
from api.http.auth import CallerDep
from api.http.deps import GateDep, RuntimeDep
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import KeyAnswer
from api.http.values import iso_time
from templates.store.api_keys import Right

router = APIRouter(prefix="/v1/key", tags=["Operations"])


@router.get(
    "",
    response_model=KeyAnswer,
    responses=error_responses(*EVERY_CALL),
    summary="The API key of this request",
)
async def get_own_key(
    request: Request, caller: CallerDep, runtime: RuntimeDep, gate: GateDep
) -> Response:
    """Any valid key may ask, for itself only: never the secret, nor its label."""
    key = await gate.query(lambda: runtime.store.api_keys.get(caller.prefix))
    levels = runtime.levels.allowed(lowest_of_key=caller.lowest_level)
    return answer(
        request,
        {
            "prefix": caller.prefix,
            "tenant": caller.tenant,
            "rights": [str(right) for right in Right if str(right) in caller.rights],
            "levels": levels,
            "liveness": str(runtime.liveness.policy),
            "expires_at": None if key is None else iso_time(key.expires_at),
            "demo": runtime.settings.demo,
        },
    )
