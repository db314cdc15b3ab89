"""What a test answers in the place of the service."""

import time
from typing import Any

from playwright.sync_api import Page, Route

from tests.patience import PATIENCE_S

DECISION = {
    "decision": "accept", "reason": "match", "level": "fmr-1e-2", "fmr": 0, "contract_id": "0" * 64,
    "calibration_id": "0" * 64, "request_id": "0" * 32,
}  # fmt: skip


class PendingRequests:
    """Requests that match a pattern, answered when the test says so."""

    def __init__(self, page: Page, pattern: str) -> None:
        self.page = page
        self.routes: list[Route] = []
        page.route(pattern, lambda route: self.routes.append(route))

    def wait(self) -> Route:
        """Wait for the first one."""
        end = time.monotonic() + PATIENCE_S
        while not self.routes:  # it comes only while the page's own loop runs
            assert time.monotonic() < end, "no such request came"
            self.page.wait_for_timeout(25)
        return self.routes[0]


def refused(
    status: int, code: str, message: str, *, wait: int | None = None, **details: Any
) -> dict[str, Any]:
    """A refusal in the form of the service, for ``Route.fulfill``."""
    return {
        "status": status,
        "headers": {} if wait is None else {"Retry-After": str(wait)},
        "json": {
            "error": {"code": code, "message": message, "details": details},
            "request_id": "0" * 32,
        },
    }
