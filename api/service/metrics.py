"""Prometheus metrics: what is counted, and the text that ``GET /metrics`` answers.

No label comes from a client: a path is its route's template, a method one of those in ``METHODS``,
and there is no tenant, no subject and no key among them. So the number of series is bounded.

Several workers share what they count through files in a private folder (prometheus_client's
multiprocess mode): each of them answers for all. The files outlive their worker, because a counter
must not fall.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from prometheus_client import (
    REGISTRY,
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    disable_created_metrics,
    generate_latest,
)
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead

from api.http.errors import ERROR_CODES
from api.service.environment import variables_set

DIRECTORY_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)

disable_created_metrics()  # type: ignore[no-untyped-call]

REQUESTS = Counter(
    "veilface_requests",
    "Requests that were answered; status is `none` where the client went away first.",
    ("route", "method", "status"),
)
REQUEST_SECONDS = Histogram(
    "veilface_request_seconds",
    "Seconds from a request's first line to its last byte, its body's arrival included.",
    ("route",),
    buckets=SECONDS,
)
ERRORS = Counter("veilface_errors", "Errors that were answered.", ("code",))
DECISIONS = Counter(
    "veilface_decisions",
    "Verifications and comparisons that were decided.",
    ("decision", "reason", "level", "probe"),
)
STEP_SECONDS = Histogram(
    "veilface_step_seconds", "Seconds that one step of a request took.", ("step",), buckets=SECONDS
)
TOKENS = Counter("veilface_tokens", "Tokens that were made for browsers.", ("action",))
LOCKED_OUT = Counter(
    "veilface_lockouts",
    "Verifications that were refused because their subject was locked for a while or disabled.",
    ("kind",),
)
RATE_LIMITED = Counter("veilface_rate_limited", "Requests over a rate limit.", ("limit",))
RATE_STORAGE_FAILURES = Counter(
    "veilface_rate_limit_storage_failures",
    "Times that the shared storage of rate limits failed, and a worker counted for itself.",
)
PURGE_FAILURES = Counter("veilface_purge_failures", "Rounds of housekeeping that failed.")
IN_FLIGHT = Gauge(
    "veilface_requests_in_flight",
    "Requests that are being answered now.",
    multiprocess_mode="livesum",
)
COMPUTE_WAITING = Gauge(
    "veilface_compute_waiting",
    "Requests that wait for a compute slot now.",
    multiprocess_mode="livesum",
)
STORE_UP = Gauge(
    "veilface_store_up",
    "Whether the database answered, and took a write after the last failure (1) or not (0).",
    multiprocess_mode="livemin",
)
MODEL_UP = Gauge(
    "veilface_model_up",
    "Whether the last inference succeeded (1) or not (0); 1 where there is no pack.",
    multiprocess_mode="livemin",
)
BUILD = Gauge(
    "veilface_build_info",
    "The program's version and the contract in force; always 1.",
    ("version", "contract_id"),
    multiprocess_mode="livemax",
)

# A worker that starts has seen no failure yet; 0 would ring the alarm at each start.
STORE_UP.set(1)
MODEL_UP.set(1)
# So that a rate over the first event is not missing: a series that appears with 1 has no rise.
for _counter, _labels in (
    (ERRORS, tuple(ERROR_CODES)),
    (RATE_LIMITED, ("key", "address")),
    (LOCKED_OUT, ("locked", "disabled")),
):
    for _label in _labels:
        _counter.labels(_label)


def step(name: str) -> AbstractContextManager[object]:
    """Measure one step of a request, in a thread or across awaits: ``with step("decide"): …``."""
    return STEP_SECONDS.labels(name).time()


def count_request(*, route: str | None, method: str, status: int, seconds: float) -> None:
    """Count one request; ``route`` is the route's template, None for a path that is unknown."""
    path, verb = route or "unmatched", method if method in METHODS else "other"
    REQUESTS.labels(path, verb, str(status) if status else "none").inc()
    REQUEST_SECONDS.labels(path).observe(seconds)


def exposition() -> bytes:
    """Write all metrics, of all workers, in Prometheus' text format 0.0.4."""
    if DIRECTORY_VARIABLE not in os.environ:
        return generate_latest(REGISTRY)
    registry = CollectorRegistry()
    MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
    return generate_latest(registry)


@contextmanager
def shared_directory() -> Iterator[None]:
    """Make the private folder in which workers count together, and remove it at the end.

    prometheus_client looks for its name when it is imported: processes that are started meanwhile
    find it.
    """
    with (
        tempfile.TemporaryDirectory(prefix="veilface-metrics-") as folder,
        variables_set({DIRECTORY_VARIABLE: folder}),
    ):
        yield


def forget_dead_workers() -> None:
    """Drop what workers that died said of the moment; what they counted stays."""
    folder = os.environ.get(DIRECTORY_VARIABLE)
    if folder is None:
        return
    for path in Path(folder).glob("gauge_live*.db"):
        pid = int(path.stem.rsplit("_", 1)[1])
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            mark_process_dead(pid)  # type: ignore[no-untyped-call]
