"""The graphs of the pack, for clients that embed: listed, and given by their hashes."""

from typing import Annotated

from fastapi import APIRouter, Depends, Path
from starlette.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from api.http.auth import AnyCall
from api.http.deps import has_copy
from api.http.errors import ApiError
from api.http.schemas import PackAnswer, PackFileEntry
from api.http.tokens import SubjectToken
from models.known_packs import KNOWN_PACKS

router = APIRouter(prefix="/v1/pack", tags=["Tokens"])

KEPT = "private, max-age=31536000, immutable"


async def token_of(call: AnyCall) -> SubjectToken:
    """Demand a token; an API key is ``forbidden``."""
    if call.token is None:
        raise ApiError(
            "forbidden",
            "the graphs are for pages: ask for a token (POST /v1/tokens), and send that",
            {"token": "missing"},
        )
    return call.token


class _WholeFile(FileResponse):
    """A file without ranges, whose errors would not have the one shape."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers = [pair for pair in scope["headers"] if pair[0] != b"range"]
        await super().__call__({**scope, "headers": headers}, receive, send)


@router.get("", dependencies=[Depends(token_of)], summary="The graphs that the contract names")
async def list_pack(call: AnyCall) -> PackAnswer:
    """Right: a token, of any action. Only where the deployment serves its pack (`serve_pack`).

    An API key is `forbidden`: its server has no use for the graphs.
    """
    pack, graphs = call.runtime.pack, call.runtime.graphs
    if pack is None or not graphs:
        raise _not_served()
    for graph in graphs.values():
        graph.require_unchanged()
    known = KNOWN_PACKS.get(pack.info.name.lower())
    return PackAnswer(
        name=pack.info.name,
        licence=None if known is None else known.licence,
        contract_id=call.runtime.contract.contract_id,
        files=[
            PackFileEntry(
                role=graph.role,
                kind=graph.kind,
                file=graph.path.name,
                sha256=graph.sha256,
                bytes=graph.size,
                path=f"{call.request.scope['root_path']}{router.prefix}/{graph.sha256}",
                input_size=list(graph.input_size),
            )
            for graph in graphs.values()
        ],
    )


@router.get(
    "/{sha256}",
    dependencies=[Depends(token_of)],
    response_class=Response,
    responses={
        200: {
            "description": "The graph's file, ONNX. `ETag` is its SHA-256.",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        },
        304: {"description": "The client's copy is the same."},
    },
    summary="One graph",
)
async def get_pack_file(
    call: AnyCall,
    sha256: Annotated[str, Path(description="Of a file of GET /v1/pack.")],
) -> Response:
    """Right: a token, of any action. Only where the deployment serves its pack.

    The path names the content, so a copy stays good for ever. Check its SHA-256 before it is run.
    `Range` is ignored.
    """
    # Looked up among the few that are served: no part of the path reaches the file system.
    graph = call.runtime.graphs.get(sha256)
    if graph is None:
        raise _not_served()
    headers = {"ETag": f'"{graph.sha256}"', "Cache-Control": KEPT}
    if has_copy(call.request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    graph.require_unchanged()
    headers["Accept-Ranges"] = "none"
    return _WholeFile(graph.path, media_type="application/octet-stream", headers=headers)


def _not_served() -> ApiError:
    return ApiError("not_found", "this deployment serves no such graph (setting serve_pack)")
