"""What is answered at once: help, version, completion, and that there is no such command."""

import json
import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

from api.cli.app import COMMANDS
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
