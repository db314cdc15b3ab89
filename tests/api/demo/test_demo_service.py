"""The demo's own service process ends with the demo."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S, wait_until

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
with service.running_service(Path(), "token"):
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
