"""A blocking HTTP client of an application in this process, with its start and stop."""

import base64
import binascii
import json
import re
from types import SimpleNamespace, TracebackType
from typing import Any, Self
from unittest.mock import patch

import httpx
import numpy as np
from anyio.from_thread import BlockingPortal, start_blocking_portal
from fastapi import FastAPI

from templates.keys.api_token import SUBJECT_TOKEN, is_token
from templates.keys.probe_signature import sign_probe

# A service begins by looking through its process for garbage. In one that holds all the tests, this
# takes longer than most of them.
NO_COLLECTION = SimpleNamespace(collect=int, freeze=int, unfreeze=int)
_VERIFY = re.compile(r"/v1/subjects/([^/]+)/verify")


def signed(path: str, authorization: str, options: dict[str, Any]) -> dict[str, Any]:
    """Add a signature to the JSON probe of a verification, where one can be made."""
    verifies, token = _VERIFY.fullmatch(path), authorization.removeprefix("Bearer ")
    body = options.get("json")
    if body is None and isinstance(options.get("content"), str):
        body = json.loads(options["content"])
    if verifies is None or not isinstance(body, dict) or "hmac" in body:
        return options
    if not (is_token(token) or SUBJECT_TOKEN.fullmatch(token)):
        return options
    probe = _probe_of(body)
    if probe is None:
        return options
    level = body.get("level")
    if level is not None and not isinstance(level, str):
        return options
    fields = sign_probe(token, verifies[1], probe, level=level).fields()
    if "json" in options:
        return {**options, "json": {**body, **fields}}
    return {**options, "content": json.dumps({**body, **fields})}


def _probe_of(body: dict[str, Any]) -> Any:
    try:
        for name in {"embedding", "embeddings"} & body.keys():
            return np.array(body[name], dtype=np.float64)
        return base64.b64decode(body["template"], validate=True)
    except (KeyError, ValueError, TypeError, OverflowError, binascii.Error):
        return None


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
            with patch("api.http.app.gc", NO_COLLECTION):
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

    def request(
        self, method: str, path: str, *, sign: bool = True, **options: Any
    ) -> httpx.Response:
        """Send a request; a probe that is not a photo is signed as by a client, unless told not."""
        headers = {**self.headers, **options.pop("headers", {})}
        authorization = headers.get("Authorization", "")
        if sign and isinstance(authorization, str):
            options = signed(path, authorization, options)
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
