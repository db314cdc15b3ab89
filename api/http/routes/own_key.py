"""What the caller's own API key is: for clients that show what they may do."""

from fastapi import APIRouter

from api.http.auth import CallerDep
from api.http.deps import Common, GateDep, RuntimeDep
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import KeyAnswer
from templates.store.api_keys import Right

router = APIRouter(prefix="/v1/key", tags=["Operations"])


@router.get("", responses=error_responses(*EVERY_CALL), summary="The API key of this request")
async def get_own_key(
    caller: CallerDep, runtime: RuntimeDep, gate: GateDep, common: Common
) -> KeyAnswer:
    """Right: any. A key is told of itself only, and never its secret nor its label."""
    key = await gate.query(lambda: runtime.store.api_keys.get(caller.prefix))
    return KeyAnswer(
        **common,
        prefix=caller.prefix,
        tenant=caller.tenant,
        rights=[right for right in Right if str(right) in caller.rights],
        levels=runtime.levels.allowed(lowest_of_key=caller.lowest_level),
        liveness=runtime.liveness.policy.value,
        expires_at=None if key is None else key.expires_at,
        demo=runtime.settings.demo,
    )
