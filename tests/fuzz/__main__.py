"""``python -m tests.fuzz``: read hostile bytes for some minutes, and count what came of it."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.report import table
from tests.fuzz.runner import SECONDS, Runner
from tests.fuzz.targets import SHARES, TARGETS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; 0 where nothing was found, 1 where something was."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description="Reads hostile bytes with the readers of Veilface, in child processes under a "
        f"limit of memory and of {SECONDS:g} s of CPU a case. Linux only: it reads /proc.",
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="in total, shared out")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="repeatable")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds give equal cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--cases", type=int, help="cases of each target, instead of --minutes")
    parser.add_argument("--out", type=Path, required=True, help="folder for inputs of findings")
    chosen = parser.parse_args(arguments)
    names = chosen.target or list(TARGETS)
    whole = sum(SHARES[name] for name in names)
    tallies = []
    for name in names:
        seconds = None if chosen.cases else chosen.minutes * 60 * SHARES[name] / whole
        runner = Runner(name, seed=chosen.seed, out=chosen.out)
        tally = runner.run(first=chosen.first, cases=chosen.cases, seconds=seconds)
        tallies.append(tally)
        print(f"{name}: {tally.cases:,} cases, {tally.findings.total()} findings", file=sys.stderr)
        for what, count in tally.findings.most_common():
            print(f"  {count} x {what}", file=sys.stderr)
    print(table(tallies))
    return 1 if any(tally.findings for tally in tallies) else 0


if __name__ == "__main__":
    sys.exit(main())
