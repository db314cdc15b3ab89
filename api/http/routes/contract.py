"""The contract in force, the decoy generator for clients that lift, and the caller's key."""

from typing import Any

from fastapi import APIRouter, Response

from api.http.auth import AnyCall, Lifts
from api.http.deps import has_copy
from api.http.errors import ApiError
from api.http.receipts import receipt_key_json
from api.http.schemas import ContractAnswer, KeyAnswer, ReceiptKey
from templates.decoys import DecoyGenerator
from templates.store.api_keys import Right

router = APIRouter(prefix="/v1", tags=["Operations"])


@router.get("/key", summary="The API key of this request")
async def get_own_key(call: AnyCall) -> KeyAnswer:
    """Right: any. A key is told of itself only, and never its secret nor its label."""
    return KeyAnswer(
        prefix=call.key.prefix,
        tenant=call.tenant,
        rights=[right for right in Right if right in call.key.rights],
        levels=call.runtime.levels.allowed(lowest_of_key=call.key.lowest_level),
        liveness=call.runtime.liveness.policy.value,
        expires_at=call.key.expires_at,
        demo=call.runtime.settings.demo,
    )


@router.get("/contract", summary="The contract and its security levels")
async def get_contract(call: AnyCall) -> ContractAnswer:
    """Right: any. What the contract seals is not part of it."""
    runtime = call.runtime
    tenant = await call.query(lambda: call.store.tenants.get(call.tenant))
    public: dict[str, Any] = runtime.contract.to_json()
    return ContractAnswer(
        **public,
        photos=runtime.pack is not None,
        generator=isinstance(runtime.source, DecoyGenerator),
        template_enrollment=tenant.template_enrollment,
        receipt_key=ReceiptKey(**receipt_key_json(call.store.signer.public_key())),
    )


@router.get(
    "/contract/generator",
    response_class=Response,
    responses={
        200: {
            "description": "The generator's file: safetensors. `X-Decoy-Source-ID` names it, and "
            "so does `ETag`.",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        },
        304: {"description": "The client's copy is the same."},
    },
    summary="The decoy generator, for clients that lift",
)
async def get_generator(call: Lifts) -> Response:
    """Right: `embeddings`. A pool of real descriptors is never given away.

    A client may keep it, and asks each time whether it still holds.
    """
    source = call.runtime.source
    if not isinstance(source, DecoyGenerator):
        raise ApiError(
            "not_found",
            "this deployment has no decoy generator to give; a decoy pool stays secret",
        )
    headers = {
        "X-Decoy-Source-ID": source.source_id,
        "ETag": f'"{source.source_id}"',
        # The path does not name the content, and a user of a copy must still have the right.
        "Cache-Control": "private, no-cache",
    }
    if has_copy(call.request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return Response(
        await call.query(source.to_bytes), media_type="application/octet-stream", headers=headers
    )
