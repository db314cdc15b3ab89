"""``python -m tests.fuzz``: read hostile bytes for some minutes, and count what came of it."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tests.fuzz.reading import SECONDS, run
from tests.fuzz.targets import TARGETS


def main(arguments: Sequence[str] | None = None) -> int:
    """Run; 0 where nothing was found, 1 where something was."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz",
        description="Reads hostile bytes with the readers of Veilface, in processes under a limit "
        f"of memory and of {SECONDS:g} s of CPU a case; a finding ends its target. Linux only.",
    )
    parser.add_argument("--minutes", type=float, default=30.0, help="in total, shared out")
    parser.add_argument("--target", action="append", choices=sorted(TARGETS), help="repeatable")
    parser.add_argument("--seed", type=int, default=0, help="equal seeds give equal cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--out", type=Path, required=True, help="folder for inputs of findings")
    chosen = parser.parse_args(arguments)
    found = 0
    print("| target | cases | accepted | reasons | slowest, ms | peak, MiB |\n|" + "---|" * 6)
    names = chosen.target or list(TARGETS)
    for name in names:
        minutes = chosen.minutes / len(names)
        tally = run(name, chosen.out / name, seed=chosen.seed, minutes=minutes, first=chosen.first)
        print(
            f"| {name} | {tally.outcomes.total():,} | {tally.outcomes['accepted']:,} | "
            f"{len(tally.reasons)} | {tally.slowest_ms:,.0f} | {tally.peak_mib:,.0f} |"
        )
        if tally.finding is not None:
            found = 1
            print(f"{name}, case {tally.case}: {tally.finding}", file=sys.stderr)
    return found


if __name__ == "__main__":
    sys.exit(main())
