"""Who asks, for the audit log; and the lines of what was refused.

What succeeds is written in the transaction that does it (``templates.store``). A refusal does
nothing, so its line is written after it, and that it could not be written does not change the
answer.
"""

import contextlib
import getpass
import logging

from starlette.requests import Request

from api.http.errors import ApiError
from api.http.schemas import REQUEST_ID
from api.service.logging import log
from templates.store.audit_log import By, Entry

ACTIONS = {
    "erase_subject": "erase",
    "export_subject": "export",
    "get_audit_log": "audit-log",
    "create_token": "token",
    "import_subject": "import",
    "unlock_subject": "lockout-reset",
}
"""Actions of routes, by the name of their function, where they are called otherwise than it. All
others have its name, with hyphens."""

UNWRITTEN = frozenset(
    {"rate_limited", "overloaded", "store_unavailable", "model_unavailable", "internal_error"}
)
"""Codes that say nothing of the caller: the service's own state. Metrics and the log count them."""


def operator() -> By:
    """Name who runs a command on this machine."""
    with contextlib.suppress(OSError, KeyError, ImportError):
        return By(f"operator:{getpass.getuser()}"[:64])
    return By("operator")


async def note_refusal(request: Request, error: ApiError, cause: Exception) -> None:
    """Write the line of a refused call, where a known key made it.

    `cause` is what was raised; the store marks what it has written itself (``recorded``).
    """
    fields = request.state.log
    route = getattr(request.scope.get("route"), "name", None)
    if route is None or "key_id" not in fields or error.code in UNWRITTEN:
        return
    if getattr(cause, "recorded", False):
        return
    entry = Entry(
        ACTIONS.get(route, route.replace("_", "-")),
        error.code,
        By(f"key:{fields['key_id']}", REQUEST_ID.get()),
        tenant=fields.get("tenant"),
        pseudonym=getattr(request.state, "pseudonym", None),
    )
    audit_log = request.app.state.runtime.store.audit_log
    try:
        await request.app.state.gate.query(lambda: audit_log.record(entry))
    except Exception as failure:
        kind = type(failure).__name__
        log("refusal not recorded", severity=logging.ERROR, code=error.code, error_type=kind)
