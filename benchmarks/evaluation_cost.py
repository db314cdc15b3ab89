r"""Time and memory of ``veilface evaluate``: wall time, and the memory of all its processes.

Memory is the proportional set size (Linux): pages that processes share count once. Run it twice
with a ``--cache``; the second run starts from known embeddings.

Example
-------
::

    python -m benchmarks.evaluation_cost lfw --pack PACK --decoys pool.veil --cache lfw.cache \
        --strategy random,adversarial,hybrid --shared-decoys --out table
"""

import json
import sys
import time
from pathlib import Path

import psutil

_EVERY_SECONDS = 0.2


def memory_of(process: psutil.Process) -> int:
    """Proportional set size of a process and all below it, in bytes."""
    total = 0
    for member in [process, *process.children(recursive=True)]:
        try:
            total += member.memory_full_info().pss
        except psutil.Error:  # it ended meanwhile
            continue
    return total


def main(arguments: list[str]) -> int:
    """Run the command with these arguments, and print what it took."""
    start = time.monotonic()
    process = psutil.Popen([sys.executable, "-P", "-m", "veilface", "evaluate", *arguments])
    peak = 0
    while process.poll() is None:
        peak = max(peak, memory_of(process))
        time.sleep(_EVERY_SECONDS)
    if process.returncode:
        return int(process.returncode)
    print(f"{time.monotonic() - start:.0f} s, at most {peak / 2**30:.2f} GiB in all processes")
    out = Path(arguments[arguments.index("--out") + 1])
    for work in json.loads((out / "results.json").read_text(encoding="utf-8"))["work"]:
        label = f"{work['strategy']} ({work['decoys'] or 'no decoys'}), m = {work['dim']}"
        print(f"{label}: {work['seconds_mean']:.2f} s a unit, {work['resumed']} resumed")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
