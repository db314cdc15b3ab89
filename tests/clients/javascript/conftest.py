"""Node with the built JavaScript client: what it computes is compared with Python's."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.required import absent

PACKAGE = Path(__file__).resolve().parents[3] / "clients" / "javascript"

Node = Callable[..., Any]


def _built() -> bool:
    """Whether the package was built of the sources that are there."""
    sources, built = PACKAGE / "src", PACKAGE / "dist"
    return all(
        (made := (built / path.relative_to(sources)).with_suffix(".js")).is_file()
        and made.stat().st_mtime >= path.stat().st_mtime
        for path in sources.rglob("*.ts")
    )


def require_client() -> str:
    """Return the path of node; skip where it, or the built package, is absent."""
    executable = shutil.which("node")
    missing = None
    if executable is None:
        missing = "there is no node"
    elif not (PACKAGE / "node_modules" / "onnxruntime-web").is_dir() or not _built():
        missing = "the JavaScript client is not built: run `make javascript`"
    if missing is not None:
        absent(missing, "VEILFACE_REQUIRE_NODE")
    return str(executable)


@pytest.fixture(scope="session")
def node() -> Node:
    """``node(driver, payload)``: runs a driver of the package's ``test/python``.

    The payload is its stdin as JSON; what it writes to stdout is returned.
    """
    executable = require_client()

    def run(driver: str, payload: object) -> Any:
        done = subprocess.run(
            [executable, f"test/python/{driver}"],
            cwd=PACKAGE,
            input=json.dumps(payload),
            env={"PATH": os.environ["PATH"]},
            text=True,
            capture_output=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run
