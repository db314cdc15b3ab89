"""A blocking HTTP client of an application in this process, with its start and stop."""

from types import TracebackType
from typing import Any, Self

import httpx
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI


class Client:
    """Sends requests to ``app`` on an event loop of its own; threads may share it."""

    def __init__(self, app: FastAPI, *, headers: dict[str, str] | None = None) -> None:
        self.app = app
        self.headers = headers or {}

    def __enter__(self) -> Self:
        self._running = start_blocking_portal()
        self._portal: BlockingPortal = self._running.__enter__()
        try:
            context = self._portal.wrap_async_context_manager(
                self.app.router.lifespan_context(self.app)
            )
            context.__enter__()
        except BaseException as error:
            self._running.__exit__(type(error), error, error.__traceback__)
            raise
        self._lifespan = context
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._lifespan.__exit__(None, None, None)
        finally:
            self._running.__exit__(kind, value, trace)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        headers = {**self.headers, **options.pop("headers", {})}
        return self._portal.call(self._send, method, path, headers, options)

    async def _send(
        self, method: str, path: str, headers: dict[str, str], options: dict[str, Any]
    ) -> httpx.Response:
        # raise_app_exceptions: nothing may get past the application's last resort.
        transport = httpx.ASGITransport(self.app, raise_app_exceptions=True)
        async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
            return await client.request(method, path, headers=headers, **options)

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def put(self, path: str, **options: Any) -> httpx.Response:
        return self.request("PUT", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)

    def delete(self, path: str, **options: Any) -> httpx.Response:
        return self.request("DELETE", path, **options)
