"""The demo's own service process: what it leaves on the disk, and that it ends with the demo."""

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from api.demo import service as demo_service
from api.http.errors import StartError
from tests.patience import PATIENCE_S, wait_until


def test_the_token_is_private_and_never_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = subprocess.Popen
    shown, modes = tmp_path / "serve.out", []

    def printing_a_token(_: list[str], **options: Any) -> Any:
        script = "import time; print('vf_token', flush=True); time.sleep(60)"
        return start([sys.executable, "-c", script], **options)

    def fail_once_the_token_is_there(*_: object) -> None:
        wait_until(lambda: "vf_token" in shown.read_text(), what="the token")
        modes.append(stat.S_IMODE(shown.stat().st_mode))
        raise StartError("the service was not ready")

    monkeypatch.setattr(demo_service.subprocess, "Popen", printing_a_token)
    monkeypatch.setattr(demo_service, "_await_ready", fail_once_the_token_is_there)
    with pytest.raises(StartError), demo_service.running_service(tmp_path):
        pass
    assert modes == [0o600]
    assert not shown.exists()


DEMO = """
import subprocess, sys
from pathlib import Path
from api.demo import service

start = subprocess.Popen

def waiting(command, **options):
    process = start([sys.executable, "-c", "import time; time.sleep(600)"], **options)
    Path("service").write_text(str(process.pid))
    return process

subprocess.Popen = waiting
with service.running_service(Path()):
    pass
"""


def test_sigterm_ends_the_service_too(tmp_path: Path) -> None:
    demo = subprocess.Popen([sys.executable, "-c", DEMO], cwd=tmp_path)
    noted = tmp_path / "service"
    wait_until(lambda: noted.is_file() and noted.read_text(), what="the service")
    demo.terminate()
    assert demo.wait(PATIENCE_S) == 128 + signal.SIGTERM
    with pytest.raises(ProcessLookupError):
        os.kill(int(noted.read_text()), 0)
