"""The REST application: routes, handlers and the life of one worker."""

import gc
import logging
import os
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from functools import cache, partial
from importlib.metadata import version
from types import ModuleType
from typing import Any

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import BaseRoute

from api.http.answers import error_answer
from api.http.audit import note_refusal
from api.http.context import RequestContext
from api.http.cors import Cors
from api.http.deps import refuse_unknown
from api.http.errors import ApiError, StartError, api_error, wrong_value
from api.http.openapi import ERRORS, DescribedApi, allowed_methods, describe, operation_id
from api.http.protocol import Protocol
from api.http.routes import (
    audit_log,
    challenges,
    contract,
    enrollment,
    health,
    lockout,
    own_key,
    pack,
    photo_check,
    subjects,
    tokens,
    transfer,
    verification,
)
from api.http.routes.page import page_routes
from api.http.routes.reference import reference_routes
from api.limits.admission import Downloads, Gate
from api.limits.rates import RateLimits
from api.service.allocator import give_back, keep_few_arenas
from api.service.housekeeping import purge_regularly
from api.service.logging import configure, log, uvicorn_log_config
from api.service.metrics import count_lockout, join_shared_directory, set_build
from api.service.opening import require_privacy, retention_of
from api.service.operations import (
    OPERATIONS_PATHS,
    Readiness,
    not_ready_once_told_to_stop,
    operations_server,
    tls_options,
)
from api.service.runtime import Runtime
from api.service.supervised import end_with_supervisor, is_supervised, open_patiently, told_to_stop
from api.settings import NO_PROXIES, Settings
from models.errors import ModelError
from templates.contract.document import Contract
from templates.contract.nobody import Nobody
from templates.distances.blas import single_threaded
from templates.errors import VeilfaceError

VERSION = version("veilface")
API = (
    verification,  # asked most, so looked at first
    own_key,
    contract,
    pack,
    tokens,
    enrollment,
    photo_check,
    subjects,
    challenges,
    lockout,
    audit_log,
    transfer,
)
GRACE_S = 20
SIGN_OF_LIFE_S = 60
"""Seconds in which a worker must show that it lives; on a busy machine, uvicorn's five are few."""


def create_app(
    settings: Settings, *, open_runtime: Callable[[Settings], Runtime] = Runtime.open
) -> FastAPI:
    """Make the application; what the settings name is opened when the server starts it."""

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
            with not_ready_once_told_to_stop(app.state.readiness):
                try:
                    yield
                finally:
                    app.state.readiness.stopping = True

    app = DescribedApi(
        _document(with_health=settings.operations_port is None),
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/v1/openapi.json",
        redirect_slashes=False,
    )
    app.state.settings = settings
    app.router.routes.extend(_built(*API))
    if settings.web_page:
        app.router.routes.extend(page_routes(demo=settings.demo, serve_pack=settings.serve_pack))
    if settings.operations_port is None:
        app.router.routes.extend(_built(health))
        _add_middleware(app, settings, operations_paths=OPERATIONS_PATHS)
    else:
        _add_middleware(app, settings, operations_paths=frozenset())
    if settings.api_docs:
        app.router.routes.extend(reference_routes())
    return app


@cache
def _built(*modules: ModuleType) -> tuple[BaseRoute, ...]:
    """The routes of modules, built now, and once for a process.

    By itself the framework builds them for the first request to any, under filters of its own for
    warnings. Those are the process's: a photo that is decoded meanwhile would change them.
    """
    router = APIRouter(generate_unique_id_function=operation_id)
    for module in modules:
        router.include_router(
            module.router, dependencies=[Depends(refuse_unknown)], responses=ERRORS
        )
    for _ in iter_route_contexts(router.routes):
        pass
    return tuple(router.routes)


@cache
def _document(*, with_health: bool) -> dict[str, Any]:
    """The OpenAPI document, made now and once for a process, for the reason of :func:`_built`."""
    health_routes = _built(health) if with_health else ()
    return describe([*_built(*API), *health_routes], version=VERSION)


def _lift_cohort(nobody: Nobody) -> None:
    try:
        _ = nobody.cohort
    except Exception as error:
        # The next lifted probe tries again.
        log("cohort not lifted", severity=logging.ERROR, error_type=type(error).__name__)


def _operations_app(app: FastAPI) -> FastAPI:
    """Make the application of the operations port: the state of ``app``, and no other routes."""
    operations_app = FastAPI(
        openapi_url=None, docs_url=None, redoc_url=None, redirect_slashes=False
    )
    operations_app.state = app.state
    operations_app.router.routes.extend(_built(health))
    _add_middleware(operations_app, app.state.settings, operations_paths=OPERATIONS_PATHS)
    return operations_app


def _add_middleware(app: FastAPI, settings: Settings, *, operations_paths: frozenset[str]) -> None:
    app.add_middleware(
        RequestContext,
        max_in_flight=settings.max_in_flight,
        operations_paths=operations_paths,
        cors=Cors(settings.allowed_origins),
        demo=settings.demo,
        tls=settings.tls_certificate is not None,
    )
    for kind in (ApiError, VeilfaceError, ModelError):
        app.add_exception_handler(kind, _known_error)
    app.add_exception_handler(HTTPException, _framework_error)
    app.add_exception_handler(RequestValidationError, _validation_error)


async def _open(
    app: FastAPI,
    settings: Settings,
    open_runtime: Callable[[Settings], Runtime],
    running: AsyncExitStack,
) -> None:
    """Open what answers requests; ``running`` closes it again, the last one first."""
    keep_few_arenas(settings.resolved_compute_slots)
    # Requests compute beside each other, as many as there are slots. Threads of the matrix library
    # would only wait for each other, and burn processor time while they do.
    running.enter_context(single_threaded())
    rate_limits = RateLimits.open(settings)
    running.push_async_callback(rate_limits.close)
    stop_told = threading.Event()
    with told_to_stop(stop_told.set):
        runtime = await anyio.to_thread.run_sync(
            open_patiently, partial(open_runtime, settings), stop_told
        )
    running.push_async_callback(_close, runtime)
    gate = Gate(slots=settings.resolved_compute_slots, waiting=settings.queue_limit)
    readiness = Readiness(runtime.store, runtime.pack, gate, runtime.keyring)
    app.state.rate_limits, app.state.runtime = rate_limits, runtime
    app.state.gate, app.state.readiness = gate, readiness
    app.state.downloads = Downloads(settings.max_in_flight // 4)
    app.state.scrapes = anyio.CapacityLimiter(1)
    await anyio.to_thread.run_sync(join_shared_directory)
    set_build(version=VERSION, contract_id=runtime.contract.contract_id)
    log(
        "started",
        version=VERSION,
        pid=os.getpid(),
        contract_id=runtime.contract.contract_id,
        pack=None if runtime.pack is None else runtime.pack.info.name,
    )
    if (weakness := require_privacy(runtime.contract, settings)) is not None:
        log(
            "weak privacy is accepted: " + weakness,
            severity=logging.WARNING,
            contract_id=runtime.contract.contract_id,
        )
    # What was made so far stays: looking through it for garbage would stop requests for 0.1 s.
    gc.collect()
    gc.freeze()
    give_back()
    running.callback(gc.unfreeze)
    tasks = await running.enter_async_context(anyio.create_task_group())
    running.callback(tasks.cancel_scope.cancel)
    tasks.start_soon(
        partial(
            purge_regularly,
            runtime.store,
            every_s=settings.purge_interval_s,
            keep=retention_of(settings),
            on_failure=readiness.note,
        )
    )
    tasks.start_soon(readiness.watch)
    if runtime.contract.takes_lifted_probes:
        # No lifted probe but one that comes now waits for it; an end of the process does not.
        threading.Thread(target=_lift_cohort, args=(runtime.nobody,), daemon=True).start()
    if is_supervised():
        tasks.start_soon(end_with_supervisor)
    if settings.operations_port is not None:
        app.state.operations_port = await running.enter_async_context(
            operations_server(
                _operations_app(app),
                host=settings.operations_host,
                port=settings.operations_port,
            )
        )


async def _close(runtime: Runtime) -> None:
    await anyio.to_thread.run_sync(runtime.close)
    log("stopped", pid=os.getpid())


def uvicorn_options(settings: Settings, contract: Contract) -> dict[str, Any]:
    """Return the keyword arguments of ``uvicorn.Config``."""
    return {
        "app": create_app(settings, open_runtime=partial(Runtime.open, contract=contract)),
        "workers": settings.workers,
        "host": settings.host,
        "port": settings.port,
        "log_config": uvicorn_log_config("warning" if settings.log_level == "info" else "info"),
        "access_log": False,
        "http": Protocol,
        "loop": "uvloop",
        "server_header": False,
        "date_header": True,
        "timeout_graceful_shutdown": GRACE_S,
        "timeout_worker_healthcheck": SIGN_OF_LIFE_S,
        "proxy_headers": settings.trusted_proxies != NO_PROXIES,
        "forwarded_allow_ips": settings.trusted_proxies,
        **tls_options(settings),
    }


async def _known_error(request: Request, error: Exception) -> Response:
    known = api_error(error)
    if known is None:
        raise error
    request.app.state.readiness.note(error)
    if known.code == "locked_out":
        count_lockout(disabled=bool(known.details.get("disabled")))
    request.state.log["code"] = known.code
    request.state.log["error_type"] = None if error is known else type(error).__name__
    await note_refusal(request, known, error)
    return error_answer(known, request.state.request_id)


async def _framework_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 - registered for this type
    code, message = {
        404: ("not_found", "there is no such path"),
        405: ("method_not_allowed", "this path does not take this method"),
        413: ("request_too_large", "the request body is too large"),
    }.get(error.status_code, ("malformed_request", "the request cannot be understood"))
    headers = dict(error.headers or {})
    if code == "method_not_allowed":
        # The page's paths are not in the document; for them the framework knows.
        allowed = allowed_methods(request.app.openapi(), request.url.path)
        headers["Allow"] = ", ".join(allowed) or headers.get("Allow", "")
    return await _known_error(request, ApiError(code, message, {}, headers))


async def _validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101 - registered for this type
    return await _known_error(request, wrong_value(error.errors()[0]))
