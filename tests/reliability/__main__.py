"""The long forms: ``python -m tests.reliability SCENARIO``; a JSON summary is printed."""

import argparse
import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from tests.reliability.cluster import Cluster
from tests.reliability.evidence import Report
from tests.reliability.kill import kill_run
from tests.reliability.outage import outage_run
from tests.reliability.races import CLIENTS, race_run

OPERATIONS_A_KILL = 10
SCENARIOS = ("kill", "races", "outage")


def run(arguments: argparse.Namespace, folder: Path, resources: ExitStack) -> Report:
    """Run one scenario."""
    operations, seed = arguments.operations, arguments.seed
    if arguments.scenario == "outage":
        cluster, modes = resources.enter_context(Cluster()), ("fast", "immediate") * 5
        return outage_run(cluster, folder, modes=modes, down_s=5.0, seed=seed)
    postgres = arguments.database == "postgres"
    url = resources.enter_context(Cluster()).url if postgres else None
    if arguments.scenario == "races":
        return race_run(url, folder, each=max(1, operations // CLIENTS), seed=seed)
    return kill_run(
        url,
        folder,
        operations=operations,
        kills=arguments.kills or operations // OPERATIONS_A_KILL,
        seed=seed,
        progress=lambda text: print(text, file=sys.stderr, flush=True),
    )


def main() -> int:
    """Run one scenario; 1 if anything was violated."""
    parser = argparse.ArgumentParser(prog="python -m tests.reliability", description=__doc__)
    parser.add_argument("scenario", choices=SCENARIOS)
    parser.add_argument("--database", choices=["sqlite", "postgres"], default="sqlite")
    parser.add_argument("--operations", type=int, default=500)
    parser.add_argument("--kills", type=int, help="default: one for ten operations")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    with ExitStack() as resources:
        folder = Path(resources.enter_context(tempfile.TemporaryDirectory(prefix="veilface-")))
        report = run(arguments, folder, resources)
    print(json.dumps({**report.figures, "violations": report.violations}, indent=1))
    return int(bool(report.violations))


if __name__ == "__main__":
    sys.exit(main())
