"""Prometheus metrics: what is counted, and the text that ``GET /metrics`` answers.

No label comes from a client: a path is its route's template, a method one of those in ``METHODS``,
and there is no tenant, no subject and no key among them. So the number of series is bounded.

Several workers share what they count through files in a private folder (prometheus_client's
multiprocess mode): each of them answers for all. It expects the folder's name before it is
imported, and workers are forks of a supervisor that has imported it, so each begins anew. A
folder's files outlive their worker, because a counter must not fall; those of dead workers are
merged into one.
"""

import fcntl
import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    disable_created_metrics,
    generate_latest,
    values,
)
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.metrics import MetricWrapperBase
from prometheus_client.metrics_core import Metric
from prometheus_client.mmap_dict import MmapedDict, mmap_key
from prometheus_client.multiprocess import MultiProcessCollector, mark_process_dead
from prometheus_client.registry import Collector

from api.http.errors import ERROR_CODES
from api.service.environment import variables_set
from api.service.logging import log

DIRECTORY_VARIABLE = "PROMETHEUS_MULTIPROC_DIR"

UNMATCHED = "unmatched"
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
LIMITS = ("key", "address")
LOCKOUTS = ("locked", "disabled")
KINDS = ("counter", "histogram", "gauge_livesum", "gauge_livemin", "gauge_livemax")
FILE_BYTES = 1024 * 1024
"""Of one file of counts: more than all series of a kind take, so that it never grows."""
DEAD = 0
"""Stands for all dead workers in a file's name; no worker has this process id."""

SECONDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 5, 10, 30)

disable_created_metrics()  # type: ignore[no-untyped-call]
REGISTRY = CollectorRegistry()

REQUESTS = Counter(
    "veilface_requests",
    "Requests that were answered; status is `none` where the client went away first.",
    ("route", "method", "status"),
    registry=REGISTRY,
)
REQUEST_SECONDS = Histogram(
    "veilface_request_seconds",
    "Seconds from a request's first line to its last byte, its body's arrival included.",
    ("route",),
    buckets=SECONDS,
    registry=REGISTRY,
)
ERRORS = Counter("veilface_errors", "Errors that were answered.", ("code",), registry=REGISTRY)
DECISIONS = Counter(
    "veilface_decisions",
    "Verifications that were decided.",
    ("decision", "reason", "level", "probe"),
    registry=REGISTRY,
)
STEP_SECONDS = Histogram(
    "veilface_step_seconds",
    "Seconds that one step of a request took.",
    ("step",),
    buckets=SECONDS,
    registry=REGISTRY,
)
TOKENS = Counter(
    "veilface_tokens", "Tokens that were made for browsers.", ("action",), registry=REGISTRY
)
LOCKED_OUT = Counter(
    "veilface_lockouts",
    "Verifications that were refused because their subject was locked for a while or disabled.",
    ("kind",),
    registry=REGISTRY,
)
RATE_LIMITED = Counter(
    "veilface_rate_limited", "Requests over a rate limit.", ("limit",), registry=REGISTRY
)
RATE_STORAGE_FAILURES = Counter(
    "veilface_rate_limit_storage_failures",
    "Times that the shared storage of rate limits failed, and a worker counted for itself.",
    registry=REGISTRY,
)
PURGE_FAILURES = Counter(
    "veilface_purge_failures", "Rounds of housekeeping that failed.", registry=REGISTRY
)
IN_FLIGHT = Gauge(
    "veilface_requests_in_flight",
    "Requests that are being answered now.",
    multiprocess_mode="livesum",
    registry=REGISTRY,
)
COMPUTE_WAITING = Gauge(
    "veilface_compute_waiting",
    "Requests that wait for a compute slot now.",
    multiprocess_mode="livesum",
    registry=REGISTRY,
)
STORE_UP = Gauge(
    "veilface_store_up",
    "Whether the database answered, and took a write after the last failure (1) or not (0).",
    multiprocess_mode="livemin",
    registry=REGISTRY,
)
MODEL_UP = Gauge(
    "veilface_model_up",
    "Whether the last inference succeeded (1) or not (0); 1 where there is no pack.",
    multiprocess_mode="livemin",
    registry=REGISTRY,
)
BUILD = Gauge(
    "veilface_build_info",
    "The program's version and the contract in force; always 1.",
    ("version", "contract_id"),
    multiprocess_mode="livemax",
    registry=REGISTRY,
)

_METRICS = [metric for metric in list(globals().values()) if isinstance(metric, MetricWrapperBase)]


def _begin() -> None:
    """Let all series begin, with values of the kind that prometheus_client makes now."""
    for metric in _METRICS:
        if metric._labelnames:
            metric._metrics.clear()
        else:
            metric._metric_init()  # type: ignore[no-untyped-call]
    # A worker that starts has seen no failure yet; 0 would ring the alarm at each start.
    STORE_UP.set(1)
    MODEL_UP.set(1)
    # So that a rate over the first event is not missing: a series that appears with 1 has no rise.
    for code in ERROR_CODES:
        ERRORS.labels(code)
    for limit in LIMITS:
        RATE_LIMITED.labels(limit)
    for kind in LOCKOUTS:
        LOCKED_OUT.labels(kind)


_begin()


def step(name: str) -> AbstractContextManager[object]:
    """Measure one step of a request, in a thread or across awaits: ``with step("decide"): …``.

    Parameters
    ----------
    name
        A fixed text: ``body``, ``photo``, ``decide``, … Each makes a series.
    """
    return STEP_SECONDS.labels(name).time()


def count_decision(*, accepted: bool, reason: str, level: str, probe: str) -> None:
    """Count one verification that was decided.

    Parameters
    ----------
    accepted, reason, level
        The decision, ``match``, ``no_match`` or ``liveness``, and the security level of the
        contract that it was made at.
    probe
        ``photo``, ``frames``, ``embedding`` or ``template``.
    """
    DECISIONS.labels("accept" if accepted else "reject", reason, level, probe).inc()


def count_request(*, route: str | None, method: str, status: int, seconds: float) -> None:
    """Count one request; ``route`` is the route's template, None for a path that is unknown."""
    named = UNMATCHED if route is None else route
    REQUESTS.labels(
        named, method if method in METHODS else "other", str(status) if status else "none"
    ).inc()
    REQUEST_SECONDS.labels(named).observe(seconds)


def count_error(code: str) -> None:
    """Count one answer with an error code."""
    ERRORS.labels(code).inc()


def count_lockout(*, disabled: bool) -> None:
    """Count one verification that was refused because of its subject's failed attempts."""
    LOCKED_OUT.labels("disabled" if disabled else "locked").inc()


def set_build(*, version: str, contract_id: str) -> None:
    """Say what runs."""
    BUILD.labels(version, contract_id).set(1)


def exposition() -> bytes:
    """Write all metrics, of all workers, in Prometheus' text format 0.0.4."""
    directory = _shared()
    if directory is None:
        return generate_latest(REGISTRY)
    registry = CollectorRegistry()
    PlatformCollector(registry=registry)
    registry.register(_Workers(directory))
    with _locked(directory):
        _forget_gauges(directory)
        MultiProcessCollector(registry, path=str(directory))  # type: ignore[no-untyped-call]
        return generate_latest(registry)


@contextmanager
def shared_directory() -> Iterator[Path]:
    """Make the private folder in which workers count together, and remove it at the end."""
    with (
        tempfile.TemporaryDirectory(prefix="veilface-metrics-") as folder,
        variables_set({DIRECTORY_VARIABLE: folder}),
    ):
        yield Path(folder)


def _shared() -> Path | None:
    folder = os.environ.get(DIRECTORY_VARIABLE)
    return None if folder is None else Path(folder)


def join_shared_directory() -> None:
    """Count in the shared folder, if there is one, from now on; a worker calls this at its start.

    What dead workers left is merged into one file. Otherwise a worker that dies again and again
    would fill the disk, and slow each scrape.
    """
    directory = _shared()
    if directory is None:
        return
    own = [directory / f"{kind}_{os.getpid()}.db" for kind in KINDS]
    try:
        with _locked(directory):
            _forget_gauges(directory)
            for kind in ("counter", "histogram"):
                _merge_dead(directory, kind)
        for path in own:
            _reserve(path)
    except OSError as error:
        for path in own:
            path.unlink(missing_ok=True)
        log(
            "no room in the folder for temporary files: /metrics lacks what this worker counts",
            severity=logging.ERROR,
            pid=os.getpid(),
            error_type=type(error).__name__,
        )
        return
    values.ValueClass = values.get_value_class()  # type: ignore[no-untyped-call]
    _begin()


def _reserve(path: Path) -> None:
    """Make a file for what is counted, with room on the disk for all of it.

    prometheus_client maps it into memory: a page for which there is no room ends the process.
    """
    with path.open("ab") as file:
        os.posix_fallocate(file.fileno(), 0, FILE_BYTES)


def _merge_dead(directory: Path, kind: str) -> None:
    dead = [path for path in directory.glob(f"{kind}_*.db") if not _alive(_pid(path))]
    if not any(_pid(path) != DEAD for path in dead):
        return
    sums = MultiProcessCollector.merge(  # type: ignore[no-untyped-call]
        [str(path) for path in dead], accumulate=False
    )
    # A glob for *.db does not find it before it is whole.
    unfinished = directory / f"{kind}.part"
    unfinished.unlink(missing_ok=True)
    _reserve(unfinished)
    merged = MmapedDict(str(unfinished))  # type: ignore[no-untyped-call]
    for metric in sums:
        for sample in metric.samples:
            merged.write_value(  # type: ignore[no-untyped-call]
                mmap_key(
                    metric.name,
                    sample.name,
                    list(sample.labels),
                    list(sample.labels.values()),
                    metric.documentation,
                ),
                sample.value,
                0.0,
            )
    merged.close()  # type: ignore[no-untyped-call]
    # First the sums take the place of what they hold already, then the rest of it goes; a death
    # between the two counts the rest twice, which is why the order keeps that time short.
    unfinished.replace(directory / f"{kind}_{DEAD}.db")
    for path in dead:
        if _pid(path) != DEAD:
            path.unlink()


def _forget_gauges(directory: Path) -> None:
    for pid in {_pid(path) for path in directory.glob("gauge_live*.db")}:
        if not _alive(pid):
            mark_process_dead(pid, str(directory))  # type: ignore[no-untyped-call]


def _pid(path: Path) -> int:
    return int(path.stem.rsplit("_", 1)[1])


def _alive(pid: int) -> bool:
    if pid == DEAD:
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


@contextmanager
def _locked(directory: Path) -> Iterator[None]:
    """Keep a scrape from reading while files are merged, which it would count twice."""
    with (directory / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


class _Workers(Collector):
    """Memory, processor time and open files of each living worker, labelled with its process id."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory

    def collect(self) -> Iterator[Metric]:
        families: dict[str, Metric] = {}
        for pid in sorted({_pid(path) for path in self._directory.glob("gauge_live*.db")}):
            own = ProcessCollector(pid=lambda pid=pid: pid, registry=None)  # type: ignore[misc]
            for metric in own.collect():
                kind = CounterMetricFamily if metric.type == "counter" else GaugeMetricFamily
                family = families.setdefault(
                    metric.name, kind(metric.name, metric.documentation, labels=["pid"])
                )
                family.add_metric([str(pid)], metric.samples[0].value)  # type: ignore[attr-defined]
        yield from families.values()


ProcessCollector(registry=REGISTRY)
PlatformCollector(registry=REGISTRY)
