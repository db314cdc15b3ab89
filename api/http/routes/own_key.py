"""What the caller's own API key is: for clients that show what they may do."""

from fastapi import APIRouter

from api.http.auth import AnyCall
from api.http.schemas import KeyAnswer
from templates.store.api_keys import Right

router = APIRouter(prefix="/v1/key", tags=["Operations"])


@router.get("", summary="The API key of this request")
async def get_own_key(call: AnyCall) -> KeyAnswer:
    """Right: any. A key is told of itself only, and never its secret nor its label."""
    return KeyAnswer(
        **call.common,
        prefix=call.key.prefix,
        tenant=call.tenant,
        rights=[right for right in Right if right in call.key.rights],
        levels=call.runtime.levels.allowed(lowest_of_key=call.key.lowest_level),
        liveness=call.runtime.liveness.policy.value,
        expires_at=call.key.expires_at,
        demo=call.runtime.settings.demo,
    )
