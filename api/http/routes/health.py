"""Health and metrics: is the process alive, can it answer, and what has it done."""

import anyio
import anyio.to_thread
from fastapi import APIRouter, Request
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from starlette.responses import Response

from api.http.answers import answer
from api.http.schemas import HealthAnswer
from api.service.metrics import exposition
from api.service.operations import Readiness

router = APIRouter(tags=["Operations"])


@router.head("/health/live", include_in_schema=False)
@router.get(
    "/health/live",
    response_model=HealthAnswer,
    summary="The process answers",
)
async def live(request: Request) -> Response:
    """Right: none. Ask nothing but the process itself."""
    return answer(request, {"status": "ok"})


@router.head("/health/ready", include_in_schema=False)
@router.get(
    "/health/ready",
    response_model=HealthAnswer,
    summary="The worker can answer requests",
)
async def ready(request: Request) -> Response:
    """Right: none. After a failed write the database must take one, a failed model infer once.

    A worker that was told to stop answers `overloaded`.
    """
    readiness: Readiness = request.app.state.readiness
    await readiness.check()
    return answer(request, {"status": "ok"})


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {
            "description": "Metrics of all workers, in Prometheus' text format 0.0.4.",
            "content": {
                "text/plain": {
                    "schema": {"type": "string"},
                    "example": "veilface_store_up 1.0\n",
                }
            },
        },
    },
    summary="What the service has done, for Prometheus",
)
async def metrics(request: Request) -> Response:
    """Right: none. No series names a subject, a tenant or an API key."""
    limiter: anyio.CapacityLimiter = request.app.state.scrapes
    text = await anyio.to_thread.run_sync(exposition, limiter=limiter)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_PLAIN_0_0_4})
