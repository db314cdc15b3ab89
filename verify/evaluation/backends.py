"""Where units and photos are worked on: processes of this machine, or a Dask cluster.

Both go through joblib. What a worker needs travels in sealed parcels (``material.Parcel``).
"""

import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypeVar
from urllib.parse import urlsplit

from templates.errors import VeilfaceError
from verify.evaluation.material import Parcel, fresh_key

T = TypeVar("T")
R = TypeVar("R")
SOFTWARE = "veilface"
CONNECT_SECONDS = 10


class BackendError(VeilfaceError):
    """The place where work was to be done cannot be used."""


@dataclass(frozen=True)
class Backend:
    """Where work is done.

    Parameters
    ----------
    scheduler
        ``tcp://…`` or ``tls://…`` address of a Dask scheduler; None for local processes.
    """

    scheduler: str | None = None
    jobs: int = 1

    @classmethod
    def parse(cls, text: str, *, jobs: int) -> "Backend":
        """Read ``local`` or ``dask://HOST:PORT`` (``dask+tls://`` where the cluster uses TLS).

        Raises
        ------
        BackendError
            It is neither.
        """
        if text == "local":
            return cls(None, jobs)
        parts = urlsplit(text)
        schemes = {"dask": "tcp", "dask+tls": "tls"}
        try:
            whole = parts.scheme in schemes and parts.hostname and parts.port
        except ValueError:
            whole = None
        if not whole or parts.path not in ("", "/") or parts.query:
            raise BackendError(f"{text} is not a backend: use local, or dask://HOST:PORT")
        return cls(f"{schemes[parts.scheme]}://{parts.netloc}", jobs)


def spread(
    backend: Backend, function: Callable[[Any, T], R], shared: object, items: Iterable[T]
) -> Iterator[tuple[int, R]]:
    """Call ``function(shared, item)`` for every item, wherever the backend works.

    Parameters
    ----------
    items
        Taken as workers get free, so that a few of them are in memory at once.

    Yields
    ------
    tuple of int and result
        Position of the item and its result, in the order in which they are ready.

    Raises
    ------
    BackendError
        The cluster cannot be used, or its workers have another version.
    """
    if backend.scheduler is None and backend.jobs == 1:
        yield from ((index, function(shared, item)) for index, item in enumerate(items))
        return
    import joblib

    key = fresh_key()
    parcel = Parcel.pack(shared, key)
    here = version(SOFTWARE)
    with _local(backend.jobs) if backend.scheduler is None else _cluster(backend.scheduler, parcel):
        # max_nbytes: joblib would otherwise write large arrays to files for its processes.
        results = joblib.Parallel(return_as="generator_unordered", max_nbytes=None)(
            joblib.delayed(_call)(function, here, parcel, index, Parcel.pack(item, key), key)
            for index, item in enumerate(items)
        )
        while True:
            try:
                index, sealed = next(results)
            except StopIteration:
                return
            except Exception as error:
                if type(error).__name__ not in _LOST:
                    raise
                raise BackendError(
                    "a worker ended in the middle of its work, most often because memory ran out: "
                    "use fewer jobs, or larger workers; the same command goes on where it stopped"
                ) from None
            yield index, sealed.open(key)


def _call(
    function: Callable[[Any, T], R],
    software: str,
    shared: Parcel,
    index: int,
    item: Parcel,
    key: bytes,
) -> tuple[int, Parcel]:
    """Do one item in a worker; all but the key arrives and leaves sealed."""
    here = version(SOFTWARE)
    if here != software:
        raise BackendError(
            f"a worker has veilface {here}, and this is {software}: install one version everywhere"
        )
    task: Any = item.open(key)
    # A cluster's worker may have several threads. The limit on the threads of products is one for
    # the process, and memory is counted for one task, so tasks of a process take turns.
    with _ALONE:
        result = function(_opened(shared, key), task)
    return index, Parcel.pack(result, key)


# Of joblib's processes, and of Dask; the latter need not be installed.
_LOST = ("TerminatedWorkerError", "BrokenProcessPool", "KilledWorker", "CommClosedError")
_LAST: dict[str, object] = {}
_ALONE = threading.Lock()


def _opened(parcel: Parcel, key: bytes) -> object:
    """Open a parcel that many tasks share; the last one stays open in the worker's memory."""
    if parcel.digest not in _LAST:
        _LAST.clear()
        _LAST[parcel.digest] = parcel.open(key)
    return _LAST[parcel.digest]


def _forget() -> None:
    """Drop the parcel that a worker has open."""
    _LAST.clear()


@contextmanager
def _local(jobs: int) -> Iterator[None]:
    import joblib
    from joblib.externals.loky import get_reusable_executor

    try:
        with joblib.parallel_config(backend="loky", n_jobs=jobs):
            yield
    finally:
        # The processes hold opened parcels; joblib would keep them for later calls.
        get_reusable_executor().shutdown(wait=True)


@contextmanager
def _cluster(scheduler: str, parcel: Parcel) -> Iterator[None]:
    import joblib

    try:
        from distributed import Client
    except ImportError:
        raise BackendError(
            'a Dask cluster needs the package distributed: pip install "veilface[cluster]"'
        ) from None
    try:
        client = Client(  # type: ignore[no-untyped-call]
            scheduler, timeout=CONNECT_SECONDS, set_as_default=False
        )
    except (OSError, TimeoutError, ValueError):
        raise BackendError(
            f"no Dask scheduler answers at {scheduler}: start one, or work on this machine"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
        except TimeoutError:
            raise BackendError(
                f"the Dask scheduler at {scheduler} has no worker: start one, with veilface "
                "installed where it runs"
            ) from None
        try:
            with joblib.parallel_config(backend="dask", client=client, scatter=[parcel]):
                yield
        finally:
            # The workers live on, and must not keep descriptors of this run.
            client.run(_forget)
