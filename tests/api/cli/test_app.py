"""What is answered at once: help, version, completion, and that there is no such command."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from api.cli.app import COMMANDS, app
from tests.api.cli.conftest import run
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[3]
STATED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
PROGRAM = """
import json, sys
from api.cli import main
sys.argv = ["veilface", *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    status = done.code
print(json.dumps([status, sorted({name.split(".")[0] for name in sys.modules})]))
"""
SLOW = {
    *("PIL", "alembic", "cryptography", "cv2", "fastapi", "joblib", "llvmlite", "matplotlib"),
    *("numba", "numpy", "onnx", "onnxruntime", "pydantic", "scipy", "sklearn", "sqlalchemy"),
    *("starlette", "torch", "uvicorn"),
}


def at_once(*arguments: str, **environment: str) -> tuple[str, int]:
    """What a command writes, and its status; it has imported nothing slow."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        cwd=ROOT, env=os.environ | environment, capture_output=True, text=True,
        timeout=PATIENCE_S, check=True,
    )  # fmt: skip
    *lines, last = done.stdout.splitlines()
    status, loaded = json.loads(last)
    assert SLOW & set(loaded) == set()
    return "\n".join(lines) + done.stderr, status


def test_the_version_is_that_of_the_project() -> None:
    shown = run("--version")
    assert (shown.status, shown.stdout, shown.stderr) == (0, f"veilface {STATED}\n", "")


def test_the_version_is_there_at_once() -> None:
    assert at_once("--version") == (f"veilface {STATED}", 0)


def test_the_help_is_there_at_once() -> None:
    shown, status = at_once("--help")
    assert status == 0
    assert all(word in shown for word in ("--version", *COMMANDS))


def test_a_wrong_command_is_refused_at_once() -> None:
    shown, status = at_once("evaluat")
    assert status == 2
    assert "Did you mean 'evaluate'?" in shown


def test_the_shell_completes_commands_at_once() -> None:
    shown, _ = at_once(
        _VEILFACE_COMPLETE="complete_bash", COMP_WORDS="veilface audit", COMP_CWORD="1"
    )
    assert shown.split() == ["audit", "audit-log"]


def test_the_shell_completes_options_of_a_command() -> None:
    completed = CliRunner().invoke(
        app,
        env={
            "_VEILFACE_COMPLETE": "complete_bash",
            "COMP_WORDS": "veilface models inspect --js",
            "COMP_CWORD": "3",
        },
        prog_name="veilface",
    )
    assert completed.stdout.split() == ["--json"]


LIBRARY = """
import sys
from veilface.__main__ import main
sys.argv[1:] = ["--version"]
try:
    main()
except SystemExit:
    from joblib import Parallel, delayed
    print(Parallel(n_jobs=2)(delayed(abs)(number) for number in [-1, -2]))
"""


@pytest.mark.parametrize(
    ("shadow", "python_path", "program", "shown"),
    [
        ("api", True, ["-m", "veilface", "verify", "--help"], "accepted"),
        ("random.py", False, ["-c", LIBRARY], "[1, 2]"),
    ],
    ids=["a folder in PYTHONPATH", "a module that a process of joblib would import"],
)
def test_a_name_of_ours_in_the_working_directory_is_not_imported(
    tmp_path: Path, shadow: str, python_path: bool, program: list[str], shown: str
) -> None:
    """So neither breaks a command, nor is run by it."""
    foreign = tmp_path / shadow
    if not foreign.suffix:
        foreign.mkdir()
        foreign /= "__init__.py"
    foreign.write_text("raise SystemExit('the wrong module')")
    environment = {name: value for name, value in os.environ.items() if name[:6] != "PYTHON"}
    if python_path:
        environment["PYTHONPATH"] = str(tmp_path)
    done = subprocess.run(
        [sys.executable, "-P", *program],
        cwd=tmp_path, env=environment, capture_output=True, text=True,
        timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert "the wrong module" not in done.stderr
    assert shown in done.stdout


INTERRUPTED = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(600)
except KeyboardInterrupt:
    raise ImportError("cv2 cannot be loaded") from None
"""


def test_ctrl_c_during_an_import_ends_the_program_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "cv2.py").write_text(INTERRUPTED)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "veilface", "verify", "ann", "photo.jpg"],
        cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(tmp_path)}, capture_output=True,
        text=True, timeout=PATIENCE_S, check=False,
        # A shell starts what runs in its background with this signal ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")
