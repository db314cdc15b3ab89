"""The demo's own service process: what it leaves on the disk."""

import stat
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from api.demo import service as demo_service
from api.http.errors import StartError
from tests.patience import wait_until


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
