"""The long forms: ``python -m tests.reliability SCENARIO``; a JSON summary is printed."""

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from tests.reliability.cluster import Cluster
from tests.reliability.full_disk import (
    FileSizeLimit,
    FullFileSystem,
    full_disk_run,
    may_mount,
    small_file_system,
)
from tests.reliability.kill import kill_run
from tests.reliability.outage import outage_run
from tests.reliability.races import lockout_run, race_run

OPERATIONS_A_KILL = 10


def _kill(arguments: argparse.Namespace, url: str | None, folder: Path) -> dict[str, Any]:
    return kill_run(
        arguments.database,
        url,
        folder,
        operations=arguments.operations,
        kills=arguments.kills or arguments.operations // OPERATIONS_A_KILL,
        seed=arguments.seed,
        progress=lambda text: print(text, file=sys.stderr, flush=True),
    ).as_dict()


def _races(arguments: argparse.Namespace, url: str | None, folder: Path) -> dict[str, Any]:
    each = max(1, arguments.operations // 32)
    return race_run(arguments.database, url, folder, each=each, seed=arguments.seed).as_dict()


def _lockout(arguments: argparse.Namespace, url: str | None, folder: Path) -> dict[str, Any]:
    return lockout_run(arguments.database, url, folder, subjects=20, seed=arguments.seed).as_dict()


def _outage(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    with Cluster() as cluster:
        modes = ("fast", "immediate") * 5
        return outage_run(cluster, folder, modes=modes, down_s=5.0, seed=arguments.seed).as_dict()


def _full_disk(arguments: argparse.Namespace, folder: Path) -> dict[str, Any]:
    report = {}
    with ExitStack() as mounts:
        if may_mount():
            small = mounts.enter_context(small_file_system())
            report["full file system"] = full_disk_run(
                FullFileSystem(small),
                small / "veilface.db",
                folder / "full",
                rounds=5,
                short_s=4.0,
                seed=arguments.seed,
            ).as_dict()
    report["limit of file sizes"] = full_disk_run(
        FileSizeLimit(),
        folder / "limit.db",
        folder / "limit",
        rounds=5,
        short_s=4.0,
        seed=arguments.seed,
    ).as_dict()
    return report


ON_EITHER: dict[str, Callable[[argparse.Namespace, str | None, Path], dict[str, Any]]] = {
    "kill": _kill,
    "races": _races,
    "lockout": _lockout,
}
ON_ONE: dict[str, Callable[[argparse.Namespace, Path], dict[str, Any]]] = {
    "outage": _outage,
    "full-disk": _full_disk,
}


def main() -> int:
    """Run one scenario; 1 if anything was violated."""
    parser = argparse.ArgumentParser(prog="python -m tests.reliability", description=__doc__)
    parser.add_argument("scenario", choices=[*ON_EITHER, *ON_ONE])
    parser.add_argument("--database", choices=["sqlite", "postgres"], default="sqlite")
    parser.add_argument("--operations", type=int, default=500)
    parser.add_argument("--kills", type=int, help="default: one for ten operations")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with ExitStack() as resources:
        folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix="veilface-")))
        if arguments.scenario in ON_ONE:
            report = ON_ONE[arguments.scenario](arguments, folder)
        else:
            postgres = arguments.database == "postgres"
            url = resources.enter_context(Cluster()).url if postgres else None
            report = ON_EITHER[arguments.scenario](arguments, url, folder)
    print(json.dumps(report, indent=1))
    return int(any(_violations(report)))


def _violations(report: dict[str, Any]) -> list[str]:
    own = list(report.get("violations", []))
    return own + [
        each for value in report.values() if isinstance(value, dict) for each in _violations(value)
    ]


if __name__ == "__main__":
    sys.exit(main())
