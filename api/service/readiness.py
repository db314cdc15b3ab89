"""Whether this worker can answer, by what it asks and by what requests ran into."""

import logging

import anyio

from api.http.errors import ApiError, StartError, api_error
from api.limits.admission import Gate
from api.service.logging import log
from api.service.metrics import MODEL_UP, STORE_UP
from api.service.opening import try_inference
from api.service.runtime import Runtime
from models.errors import ModelError
from templates.errors import StoreBusy, StoreError
from templates.store.tenants import RetiredRotation

WATCH_S = 5.0
UP = {"store": STORE_UP, "model": MODEL_UP}


class Readiness:
    """What is known to fail.

    A database may answer and yet take no write, and a model may be there and yet fail. So after a
    failure the thing that failed must succeed once before the worker is ready again.
    """

    def __init__(self, runtime: Runtime, gate: Gate) -> None:
        self._store, self._pack, self._keyring = runtime.store, runtime.pack, runtime.keyring
        self._stale = False
        self._gate = gate
        self._failed: set[str] = set()
        for gauge in UP.values():
            gauge.set(1)

    def note(self, error: Exception) -> None:
        """Take note of an error that some work ended with, if it says that store or model fail."""
        code = api_error(error).code
        if isinstance(error, ApiError | StoreBusy | RetiredRotation):
            return
        if code == "store_unavailable" and isinstance(error, StoreError):
            failed = "store"
        elif code == "model_unavailable":
            failed = "model"
        else:
            return
        if failed not in self._failed:
            kind = type(error).__name__
            log(f"{failed} failed", severity=logging.ERROR, code=code, error_type=kind)
        self._failed.add(failed)
        UP[failed].set(0)

    async def check(self) -> None:
        """Ask the database, and try again what failed last."""
        try:
            await self._gate.query(self._store.ping)
            if "store" in self._failed:
                await self._gate.query(self._store.ping_write)
                self._recovered("store")
            if "model" in self._failed:
                await self._gate.compute(self._infer, key="")
                self._recovered("model")
        except Exception as error:
            self.note(error)
            raise

    async def watch(self, *, every_s: float = WATCH_S) -> None:
        """Check now and then, so that metrics are right where nobody asks, until cancelled."""
        while True:
            await anyio.sleep(every_s)
            try:
                await self.check()
            except Exception as error:
                # Noted already. The next look must come: this task ends with the worker only.
                log("check failed", severity=logging.DEBUG, error_type=type(error).__name__)
            self._watch_keys()

    def _watch_keys(self) -> None:
        stale = self._keyring.stale_reason is not None
        if stale and not self._stale:
            # A rotation by another user, or a broken file: the old key goes on sealing.
            log("the master keys changed and cannot be read", severity=logging.ERROR)
        self._stale = stale

    def _infer(self) -> None:
        assert self._pack is not None  # noqa: S101 - no inference fails without a pack
        try:
            try_inference(self._pack)
        except StartError as error:
            raise ModelError(str(error)) from error

    def _recovered(self, what: str) -> None:
        log(f"{what} is available again")
        self._failed.discard(what)
        UP[what].set(1)
