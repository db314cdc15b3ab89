"""Log lines: one JSON object a line, to stderr, from a list of fields that may be there.

A line never holds a subject id, a token, a byte of a photo or template, or a number of an
embedding. That is why nothing of an exception but its type is written, and why a request is named
by its route's template (`/v1/subjects/{subject_id}/verify`) and never by its path. A subject
appears as a pseudonym only, an HMAC under a key that is kept sealed in the store.
"""

import datetime
import json
import logging
import sys
from typing import Any

LOGGER, UVICORN = "veilface", "uvicorn"
FIELDS = frozenset({
    "request_id", "method", "route", "status", "code", "duration_ms", "tenant", "key_id",
    "token_id", "subject", "decision", "liveness", "security_level", "error_type", "receipt_id",
    "log_purged", "subjects", "contract_id", "version", "pack", "pid",
})  # fmt: skip


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object; of an exception it keeps the type only."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line."""
        line: dict[str, Any] = {
            "time": datetime.datetime.fromtimestamp(record.created, datetime.UTC).isoformat(
                timespec="milliseconds"
            ),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage() if record.exc_info is None else str(record.msg),
        }
        line.update(getattr(record, "fields", {}))
        if record.exc_info and record.exc_info[0] is not None:
            line["error_type"] = record.exc_info[0].__name__
        return json.dumps(line)


class _ToStderr(logging.StreamHandler[Any]):
    """Writes to whatever ``sys.stderr`` is at that moment."""

    def __init__(self) -> None:
        super().__init__(sys.stderr)

    def emit(self, record: logging.LogRecord) -> None:
        self.stream = sys.stderr
        super().emit(record)


def log(event: str, *, severity: int = logging.INFO, **fields: Any) -> None:
    """Write one line: a fixed text, never built from input, and fields named in ``FIELDS``."""
    unknown = set(fields) - FIELDS
    if unknown:
        raise ValueError(f"log fields that are not declared: {sorted(unknown)}")
    kept = {name: value for name, value in fields.items() if value is not None}
    logging.getLogger(LOGGER).log(severity, event, extra={"fields": kept})


def configure(level: str) -> None:
    """Send our lines and uvicorn's to stderr from now on; again, it only changes the level.

    At `info` uvicorn logs starts and stops, of which our own lines say more: so it is set to
    `warning`.
    """
    for name, least in ((LOGGER, level), (UVICORN, "warning" if level == "info" else level)):
        logger = logging.getLogger(name)
        logger.setLevel(least.upper())
        logger.propagate = name == LOGGER
        if not any(isinstance(handler, _ToStderr) for handler in logger.handlers):
            handler = _ToStderr()
            handler.setFormatter(JsonLines())
            logger.addHandler(handler)
