"""Run the demo and draw what it prints as a picture for the README.

Example
-------
::

    python -m benchmarks.demo_picture docs/demo.svg
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.text import Text

from benchmarks.deployment import VEILFACE

WIDTH = 160


def main() -> None:
    """Draw the demo's output on a terminal of fixed width, with the reader's own fonts."""
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [str(VEILFACE), "demo", "--folder", "demo-data"],
            cwd=folder,
            env={"PATH": f"{VEILFACE.parent}:/usr/bin:/bin", "LANG": "C.UTF-8"},
            text=True,
            stdout=subprocess.PIPE,
            check=True,
        )
    console = Console(record=True, width=WIDTH, file=Path("/dev/null").open("w"))  # noqa: SIM115
    console.print(Text.from_ansi(done.stdout.strip()))
    drawn = console.export_svg(title="make demo")
    Path(sys.argv[1]).write_text(re.sub(r"@font-face \{.*?\}\s*", "", drawn, flags=re.S))


if __name__ == "__main__":
    main()
