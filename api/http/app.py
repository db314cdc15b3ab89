"""The REST application: routes, handlers and the life of one worker."""

import gc
import logging
import os
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from importlib.metadata import version
from typing import NoReturn

import anyio
import anyio.to_thread
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp

from api.http.context import RequestContext
from api.http.deps import refuse_unknown
from api.http.errors import StartError
from api.http.openapi import DESCRIPTION, ERRORS, TAGS, operation_id
from api.http.routes import (
    audit_log,
    challenges,
    contract,
    enrollment,
    health,
    pack,
    photos,
    subjects,
    tokens,
    transfer,
    verification,
)
from api.http.routes.drawn_people import drawn_people_routes
from api.http.routes.page import page_routes
from api.http.routes.reference import document_routes, reference_routes
from api.limits.admission import Gate
from api.limits.rates import RateLimits
from api.service.allocator import give_back
from api.service.housekeeping import purge_regularly
from api.service.logging import configure, log
from api.service.metrics import BUILD, forget_dead_workers
from api.service.opening import retention_of, weak_privacy
from api.service.readiness import Readiness
from api.service.runtime import Runtime
from api.settings import Settings
from templates.contract.nobody import Nobody
from templates.distances.blas import single_threaded

VERSION = version("veilface")
API = (
    verification,  # asked most, so looked at first
    contract,
    pack,
    tokens,
    enrollment,
    photos,
    subjects,
    challenges,
    audit_log,
    transfer,
    health,
)


class Cors(CORSMiddleware):
    """Starlette's, but the application answers a preflight that is refused, in the one shape."""

    def preflight_response(self, request_headers: Headers) -> ASGIApp:  # type: ignore[override]
        """Return what answers a preflight."""
        answer = super().preflight_response(request_headers)
        return answer if answer.status_code == 200 else self.app


CORS_METHODS = ("GET", "PUT", "POST", "DELETE")
CORS_REQUEST_HEADERS = (
    "Authorization",
    "Content-Type",
    "If-Match",
    "If-None-Match",
    "X-Request-ID",
)
CORS_ANSWER_HEADERS = (
    "ETag",
    "Retry-After",
    "X-Decoy-Source-ID",
    "X-Request-ID",
    "X-Veilface-Notice",
)


def create_app(
    settings: Settings, *, open_runtime: Callable[[Settings], Runtime] = Runtime.open
) -> FastAPI:
    """Make the application; ``open_runtime`` gives what answers when the server starts it."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        configure(settings.log_level)
        async with AsyncExitStack() as running:
            try:
                await _open(app, settings, open_runtime, running)
            except StartError as error:
                # Its sentence is written for the operator and holds no secret.
                log("start failed: " + str(error), severity=logging.ERROR)
                raise
            yield

    app = FastAPI(
        title="Veilface",
        version=VERSION,
        description=DESCRIPTION,
        openapi_tags=[*TAGS],
        openapi_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
        dependencies=[Depends(refuse_unknown)],
        responses=ERRORS,
        generate_unique_id_function=operation_id,
        exception_handlers={HTTPException: _pass_on, RequestValidationError: _pass_on},
    )
    app.state.settings = settings
    for module in API:
        app.include_router(module.router)
    # Now, and not for a first request: the framework makes it under filters of its own for
    # warnings, which are the process's. A photo that is decoded meanwhile would change them.
    document = app.openapi()
    routes = app.router.routes
    routes += document_routes(document, root_path=settings.root_path)
    if settings.web_page:
        routes += page_routes(demo=settings.demo, serve_pack=settings.serve_pack)
        routes += reference_routes()
        if settings.demo:
            routes += drawn_people_routes()
    _add_middleware(app, settings)
    return app


def _lift_cohort(nobody: Nobody) -> None:
    try:
        _ = nobody.cohort
        give_back()
    except Exception as error:
        # The next lifted probe tries again.
        log("cohort not lifted", severity=logging.ERROR, error_type=type(error).__name__)


def _add_middleware(app: FastAPI, settings: Settings) -> None:
    app.add_middleware(
        RequestContext,
        root_path=settings.root_path,
        demo=settings.demo,
        tls=settings.tls_certificate is not None,
    )
    if settings.allowed_origins:
        # Keys travel in headers and never in a cookie, so credentials are not allowed: a page can
        # call with a key that it has, and with nothing that the browser keeps for the service.
        app.add_middleware(
            Cors,
            allow_origins=sorted(settings.allowed_origins),
            allow_methods=CORS_METHODS,
            allow_headers=CORS_REQUEST_HEADERS,
            expose_headers=CORS_ANSWER_HEADERS,
        )


async def _open(
    app: FastAPI,
    settings: Settings,
    open_runtime: Callable[[Settings], Runtime],
    running: AsyncExitStack,
) -> None:
    """Open what answers requests; ``running`` closes it again, the last one first."""
    # Requests compute beside each other, as many as there are slots. Threads of the matrix library
    # would only wait for each other, and burn processor time while they do.
    running.enter_context(single_threaded())
    rate_limits = RateLimits.open(settings)
    running.push_async_callback(rate_limits.close)
    runtime = await anyio.to_thread.run_sync(open_runtime, settings)
    running.push_async_callback(_close, runtime)
    gate = Gate(slots=settings.resolved_compute_slots, waiting=settings.queue_limit)
    readiness = Readiness(runtime, gate)
    app.state.rate_limits, app.state.runtime = rate_limits, runtime
    app.state.gate, app.state.readiness = gate, readiness
    forget_dead_workers()
    BUILD.labels(VERSION, runtime.contract.contract_id).set(1)
    log(
        "started",
        version=VERSION,
        pid=os.getpid(),
        contract_id=runtime.contract.contract_id,
        pack=None if runtime.pack is None else runtime.pack.info.name,
    )
    if (weakness := weak_privacy(runtime.contract)) is not None:
        log(
            "privacy is not proven: " + weakness,
            severity=logging.WARNING,
            contract_id=runtime.contract.contract_id,
        )
    # What was made so far stays: looking through it for garbage would stop requests for 0.1 s.
    gc.collect()
    gc.freeze()
    running.callback(gc.unfreeze)
    give_back()
    tasks = await running.enter_async_context(anyio.create_task_group())
    running.callback(tasks.cancel_scope.cancel)
    keep = retention_of(settings)
    tasks.start_soon(purge_regularly, runtime.store, keep, readiness.note)
    tasks.start_soon(readiness.watch)
    if runtime.contract.takes_lifted_probes:
        # No lifted probe but one that comes now waits for it; an end of the process does not.
        threading.Thread(target=_lift_cohort, args=(runtime.nobody,), daemon=True).start()


async def _close(runtime: Runtime) -> None:
    await anyio.to_thread.run_sync(runtime.close)
    log("stopped", pid=os.getpid())


async def _pass_on(_: Request, error: Exception) -> NoReturn:
    """Leave an exception of the framework to :class:`RequestContext`, as all others are."""
    raise error
