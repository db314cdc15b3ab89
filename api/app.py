"""The REST application: routes, handlers and the life of one worker."""

import logging
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import anyio.to_thread
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response

from api.answers import error_answer
from api.context import RequestContext
from api.errors import ApiError, StartError, api_error
from api.housekeeping import purge_regularly
from api.limits import Gate
from api.logging import configure, log, uvicorn_log_config
from api.openapi import DESCRIPTION
from api.routes import contract, enrollment, health, subjects, transfer, verification
from api.runtime import Runtime
from api.settings import ENV_PREFIX, Settings, load_settings
from models.errors import ModelError
from templates.distances import warm_up
from templates.errors import VeilfaceError

VERSION = "0.1.0"
GRACE_S = 20


def create_app(
    settings: Settings, *, open_runtime: Callable[[Settings], Runtime] = Runtime.open
) -> FastAPI:
    """Make the application; what the settings name is opened when the server starts it."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        configure(settings.log_level)
        try:
            runtime = await anyio.to_thread.run_sync(open_runtime, settings)
        except StartError as error:
            # Its sentence is written for the operator and holds no secret.
            log("start failed: " + str(error), severity=logging.ERROR)
            raise
        app.state.runtime = runtime
        app.state.gate = Gate(slots=settings.resolved_compute_slots, waiting=settings.queue_limit)
        log(
            "started",
            version=VERSION,
            pid=os.getpid(),
            contract_id=runtime.contract.contract_id,
            pack=None if runtime.pack is None else runtime.pack.info.name,
        )
        try:
            # No request is answered before this is done, so none waits for the compiler.
            await anyio.to_thread.run_sync(warm_up)
            async with anyio.create_task_group() as tasks:
                tasks.start_soon(
                    partial(purge_regularly, runtime.store, every_s=settings.purge_interval_s)
                )
                try:
                    yield
                finally:
                    tasks.cancel_scope.cancel()
        finally:
            await anyio.to_thread.run_sync(runtime.close)
            log("stopped", pid=os.getpid())

    app = FastAPI(
        title="Veilface",
        version=VERSION,
        description=DESCRIPTION,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        openapi_url="/v1/openapi.json",
        redirect_slashes=False,
    )
    app.state.settings = settings
    app.add_middleware(RequestContext, demo=settings.demo)
    for kind in (ApiError, VeilfaceError, ModelError):
        app.add_exception_handler(kind, _known_error)
    app.add_exception_handler(HTTPException, _framework_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    for routes in (health, contract, subjects, enrollment, verification, transfer):
        app.include_router(routes.router)
    return app


def app_from_environment() -> FastAPI:
    """Make the application in a worker process; ``uvicorn_options`` passed the settings on."""
    return create_app(load_settings())


def uvicorn_options(settings: Settings) -> dict[str, Any]:
    """Return the keyword arguments of ``uvicorn.run``.

    With one worker the application itself is passed; with several, the settings travel to the
    workers in the environment, because they are started anew.
    """
    options: dict[str, Any] = {
        "host": settings.host,
        "port": settings.port,
        "log_config": uvicorn_log_config("warning" if settings.log_level == "info" else "info"),
        "access_log": False,
        "server_header": False,
        "date_header": True,
        "timeout_graceful_shutdown": GRACE_S,
    }
    if settings.workers == 1:
        return {"app": create_app(settings), **options}
    os.environ.update(environment_of(settings))
    return {
        "app": "api.app:app_from_environment",
        "factory": True,
        "workers": settings.workers,
        **options,
    }


def environment_of(settings: Settings) -> dict[str, str]:
    """Write the settings as environment variables.

    All of them, because a setting that equals its default may have been given as a flag, over
    another value in the TOML file.
    """
    values = {name: getattr(settings, name) for name in Settings.model_fields}
    return {
        ENV_PREFIX + name.upper(): ",".join(value) if isinstance(value, tuple) else str(value)
        for name, value in values.items()
        if value is not None
    }


async def _known_error(request: Request, error: Exception) -> Response:
    known = api_error(error)
    if known is None:
        raise error
    request.state.log["code"] = known.code
    request.state.log["error_type"] = None if error is known else type(error).__name__
    return error_answer(known, request.state.request_id)


async def _framework_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)  # noqa: S101 - registered for this type
    code, message = {
        404: ("not_found", "there is no such path"),
        405: ("method_not_allowed", "this path does not take this method"),
        413: ("request_too_large", "the request body is too large"),
    }.get(error.status_code, ("malformed_request", "the request cannot be understood"))
    return await _known_error(request, ApiError(code, message, {}, dict(error.headers or {})))


async def _validation_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101 - registered for this type
    # Only the names of fields and the validator's own words: the input is not repeated.
    problems = [
        {"field": ".".join(map(str, problem["loc"][1:])), "problem": problem["type"]}
        for problem in error.errors()
    ]
    return await _known_error(
        request,
        ApiError("validation_failed", "a parameter has a wrong value", {"problems": problems}),
    )
