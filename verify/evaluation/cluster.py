"""A Dask cluster that computes the units of an evaluation.

Scheduler and workers are trusted: they get the embeddings of the set with each task. A worker
keeps the arguments of a task in memory only. What it may spill to disk is the result of one:
similarities of pairs.
"""

import warnings
from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from importlib.metadata import version

from templates.errors import VeilfaceError
from verify.evaluation.provenance import SOFTWARE

CONNECT_SECONDS = 10


class ClusterError(VeilfaceError):
    """The cluster cannot be used."""


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """Connect to a Dask scheduler, and give its executor."""
    try:
        from distributed import Client
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker
    except ModuleNotFoundError:
        raise ClusterError(
            'a Dask cluster needs the package distributed: pip install "veilface[cluster]"'
        ) from None
    try:
        client = Client(  # type: ignore[no-untyped-call]
            address, timeout=CONNECT_SECONDS, set_as_default=False
        )
    except (OSError, TimeoutError, ValueError):
        raise ClusterError(
            f"no Dask scheduler answers at {address}, expected an address such as tcp://HOST:PORT"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=CONNECT_SECONDS)
            installed = set(client.run(version, SOFTWARE).values())
        except TimeoutError:
            raise ClusterError(
                f"the Dask scheduler at {address} has no worker: start one"
            ) from None
        except ModuleNotFoundError:
            raise ClusterError(f"a worker of {address} has no veilface: install it there") from None
        if installed != {version(SOFTWARE)}:
            raise ClusterError(
                f"workers have veilface {', '.join(sorted(installed))}, and this is "
                f"{version(SOFTWARE)}: install one version everywhere"
            )
        try:
            with warnings.catch_warnings():
                # All units share one set of pairs, which Dask would have us store on the workers.
                warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
                yield client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        except (KilledWorker, CommClosedError, CancelledError):
            raise ClusterError(
                "the cluster lost a worker in the middle of its work, most often because memory "
                "ran out: start larger workers, with one thread each"
            ) from None
