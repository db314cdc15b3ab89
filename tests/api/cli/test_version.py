"""`veilface --version`: one line, at once."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

from tests.api.cli.conftest import run
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
STATED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PROGRAM = """
import json, sys
from api.cli import main
sys.argv = ["veilface", "--version"]
try:
    main()
except SystemExit as done:
    status = done.code
print(json.dumps([status, sorted({name.split(".")[0] for name in sys.modules})]))
"""


def test_the_version_is_that_of_the_project() -> None:
    shown = run("--version")
    assert (shown.status, shown.stdout, shown.stderr) == (0, f"veilface {STATED}\n", "")


def test_the_help_names_the_option() -> None:
    assert "--version" in run("--help").stdout


def test_the_version_waits_for_no_library_of_the_commands() -> None:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    line, modules = done.stdout.splitlines()
    status, loaded = json.loads(modules)
    assert (line, status) == (f"veilface {STATED}", 0)
    slow = {"PIL", "cv2", "fastapi", "numba", "numpy", "onnx", "onnxruntime", "scipy", "sqlalchemy"}
    assert slow & set(loaded) == set()
