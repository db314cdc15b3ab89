"""Health and metrics: is the process alive, can it answer, and what has it done."""

import anyio.to_thread
from fastapi import APIRouter, Depends, Request
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4
from starlette.responses import Response

from api.http.auth import BearerDep, call_of
from api.http.schemas import HealthAnswer
from api.service.metrics import exposition
from api.service.readiness import Readiness

router = APIRouter(tags=["Operations"])


@router.head("/health/live", include_in_schema=False)
@router.get("/health/live", summary="The process answers")
async def live() -> HealthAnswer:
    """Right: none. Ask nothing but the process itself."""
    return HealthAnswer(status="ok")


@router.head("/health/ready", include_in_schema=False)
@router.get("/health/ready", summary="The worker can answer requests")
async def ready(request: Request) -> HealthAnswer:
    """Right: none. After a failed write the database must take one, a failed model infer once."""
    readiness: Readiness = request.app.state.readiness
    await readiness.check()
    return HealthAnswer(status="ok")


async def may_read_metrics(request: Request, bearer: BearerDep = None) -> None:
    """Demand a key with the right, unless the setting opens the metrics."""
    if not request.app.state.settings.open_metrics:
        (await call_of(request, bearer)).require("metrics")


@router.get(
    "/metrics",
    dependencies=[Depends(may_read_metrics)],
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
async def metrics() -> Response:
    """Right: `metrics`. No series names a subject, a tenant or an API key."""
    text = await anyio.to_thread.run_sync(exposition)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_PLAIN_0_0_4})
