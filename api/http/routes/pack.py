"""The graphs of the pack, for clients that embed: listed, and given by their hashes."""

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request
from starlette.responses import FileResponse, Response

from api.http.answers import answer
from api.http.auth import caller
from api.http.deps import RuntimeDep
from api.http.errors import ApiError
from api.http.openapi import EVERY_CALL, error_responses
from api.http.schemas import PackAnswer
from api.process.served_graphs import licence_of

router = APIRouter(prefix="/v1/pack", tags=["contract"])

KEPT = "private, max-age=31536000, immutable"


@router.get(
    "",
    dependencies=[Depends(caller)],
    response_model=PackAnswer,
    responses=error_responses(*EVERY_CALL, "forbidden", "not_found", "replayed"),
    summary="The graphs that the contract names",
)
async def list_pack(request: Request, runtime: RuntimeDep) -> Response:
    """Any valid key or token may read it, where the deployment serves its pack (`serve_pack`)."""
    pack = runtime.pack
    if pack is None or not runtime.graphs:
        raise _not_served()
    return answer(
        request,
        {
            "name": pack.info.name,
            "licence": licence_of(pack),
            "contract_id": runtime.contract.contract_id,
            "files": [
                {
                    "role": graph.role,
                    "kind": graph.kind,
                    "file": graph.file,
                    "sha256": graph.sha256,
                    "bytes": graph.size,
                    "path": f"{router.prefix}/{graph.sha256}",
                    "input_size": list(graph.input_size),
                }
                for graph in runtime.graphs.values()
            ],
        },
    )


@router.get(
    "/{sha256}",
    dependencies=[Depends(caller)],
    response_class=Response,
    responses={
        200: {
            "description": "The graph's file, ONNX. `ETag` is its SHA-256.",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        },
        206: {
            "description": "The range of bytes that was asked for.",
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        },
        304: {"description": "The client's copy is the same."},
        **error_responses(
            *EVERY_CALL,
            "forbidden",
            "not_found",
            "replayed",
            "validation_failed",
            "model_unavailable",
        ),
    },
    summary="One graph",
)
async def get_pack_file(
    request: Request,
    runtime: RuntimeDep,
    sha256: Annotated[str, Path(description="Of a file of GET /v1/pack.")],
) -> Response:
    """Any valid key or token may fetch it, where the deployment serves its pack.

    The path names the content, so a copy stays good for ever. Check its SHA-256 before it is run.
    """
    # Looked up among the few that are served: no part of the path reaches the file system.
    graph = runtime.graphs.get(sha256)
    if graph is None:
        raise _not_served()
    headers = {"ETag": f'"{graph.sha256}"', "Cache-Control": KEPT}
    tags = request.headers.get("if-none-match", "").split(",")
    if {tag.strip().removeprefix("W/") for tag in tags} & {headers["ETag"], "*"}:
        return Response(status_code=304, headers=headers)
    graph.require_unchanged()
    return FileResponse(graph.path, media_type="application/octet-stream", headers=headers)


def _not_served() -> ApiError:
    return ApiError("not_found", "this deployment serves no such graph (setting serve_pack)")
