"""Health: is the process alive, and can it answer."""

from fastapi import APIRouter, Request
from starlette.responses import Response

from api.answers import answer
from api.deps import GateDep, RuntimeDep
from api.openapi import error_responses
from api.schemas import HealthAnswer

router = APIRouter(prefix="/health", tags=["health"])


@router.get(
    "/live",
    response_model=HealthAnswer,
    responses=error_responses("internal_error"),
    summary="The process answers",
)
async def live(request: Request) -> Response:
    """Ask nothing but the process itself."""
    return answer(request, {"status": "ok"})


@router.get(
    "/ready",
    response_model=HealthAnswer,
    responses=error_responses("store_unavailable", "internal_error"),
    summary="The database answers, and the model did at the start",
)
async def ready(request: Request, runtime: RuntimeDep, gate: GateDep) -> Response:
    """Ask the database. A pack whose first inference fails stops the start already."""
    await gate.query(runtime.store.ping)
    return answer(request, {"status": "ok"})
