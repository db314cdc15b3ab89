"""``python -m benchmarks NAME``: measure, and print the table that a page quotes.

Every module has ``add_options(parser)`` and ``measure(args)``, which returns the rows of the table.
A row whose ``verdict`` is FAIL makes the exit status 1.
"""

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence

NAMES = {
    "browser_client": "the JavaScript client in Chromium, and what leaves the browser",
    "end_to_end": "FRR and FMR of the running service on LFW, by photos or lifted probes",
    "operating_point": "what privacy costs: theft and false rejections by the photos spared",
    "readme_results": "the table of docs/evaluation.md, from results of veilface evaluate",
    "request_overhead": "a verification by photo beside the bare models",
    "service_load": "requests a second, latencies, CPU and memory under load",
    "soak": "memory and latencies under a mixed load for hours",
    "timing_oracle": "whether the time of an answer tells who is enrolled",
}


def table(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows as a Markdown table; columns are those of all rows, in their order."""
    titles = list(dict.fromkeys(title for row in rows for title in row))
    lines = [titles, ["---"] * len(titles)]
    lines += [[str(row.get(title, "")) for title in titles] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main(arguments: Sequence[str]) -> int:
    """Run the measurement that is named."""
    if not arguments or arguments[0] not in NAMES:
        width = max(map(len, NAMES))
        print("usage: python -m benchmarks NAME [OPTIONS]\n")
        print("\n".join(f"  {name:{width}}  {text}" for name, text in NAMES.items()))
        return 2
    name = arguments[0]
    module = importlib.import_module(f"benchmarks.{name}")
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_options(parser)
    rows = module.measure(parser.parse_args(arguments[1:]))
    print(table(rows))
    return int(any(row.get("verdict") == "FAIL" for row in rows))


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
