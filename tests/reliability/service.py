"""``veilface serve`` as a process group of its own, which can be killed and started again."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx
import psutil

from tests.api.deployment import Deployment, environment_of
from tests.patience import PATIENCE_S

START_S = PATIENCE_S
ROOT = Path(__file__).resolve().parents[2]


class Service:
    """One deployment's service on its port; it may be started as often as it was killed.

    Parameters
    ----------
    within
        Program, with its arguments, that runs it somewhere else than here.
    """

    def __init__(self, deployment: Deployment, folder: Path, within: Sequence[str] = ()) -> None:
        self.deployment = deployment
        self.url = f"http://{deployment.settings.host}:{deployment.settings.port}"
        self.within = within
        self.up = threading.Event()
        self.starts = 0
        self.log: list[dict[str, Any]] = []
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Service":
        try:
            self.start()
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        """Start it, and return when every worker is ready."""
        self.starts += 1
        self._process = subprocess.Popen(
            [*self.within, sys.executable, "-m", "veilface", "serve"],
            cwd=ROOT,
            env=self.environment(),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._collect, args=(self._process,), daemon=True)
        self._reader.start()
        self.wait_for_workers()
        self.up.set()

    def environment(self) -> dict[str, str]:
        """What its processes are started with."""
        return {
            **{k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")},
            **environment_of(self.deployment.settings),
            "OMP_NUM_THREADS": "1",
            "TMPDIR": str(self._folder),
        }

    def wait_for_workers(self) -> None:
        """Return when as many workers as there should be have opened their runtime."""
        deadline = time.monotonic() + START_S
        while len(self.workers()) < self.deployment.settings.workers or not self.is_ready():
            if self.process.poll() is not None:
                raise AssertionError(f"the service ended with {self.process.poll()}: {self.tail()}")
            if time.monotonic() > deadline:
                raise AssertionError(f"not ready after {START_S:.0f} s: {self.tail()}")
            time.sleep(0.05)

    def is_ready(self) -> bool:
        """Whether a worker says that it is ready."""
        try:
            # Asked again: a worker that was killed may have taken the connection.
            return (
                httpx.get(f"{self.url}/health/ready", timeout=10, trust_env=False).status_code
                == 200
            )
        except httpx.TransportError:
            return False

    @property
    def process(self) -> "subprocess.Popen[bytes]":
        """The supervisor of the workers."""
        assert self._process is not None
        return self._process

    def workers(self) -> list[int]:
        """Process ids of the workers that live and have opened their runtime."""
        opened = {line["pid"] for line in list(self.log) if line.get("event") == "started"}
        try:
            children = psutil.Process(self.process.pid).children()
            return [each.pid for each in children if each.pid in opened and _lives(each)]
        except psutil.NoSuchProcess:
            return []

    def kill_worker(self, pid: int) -> None:
        """SIGKILL one worker; the supervisor starts another one."""
        os.kill(pid, signal.SIGKILL)

    def kill(self) -> None:
        """SIGKILL the supervisor and all workers at once, and wait until they are gone."""
        self.up.clear()
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        deadline = time.monotonic() + PATIENCE_S
        while _group_lives(self._process.pid):
            if time.monotonic() > deadline:
                raise AssertionError("killed processes are still there")
            time.sleep(0.005)
        self._reader.join()

    def stop(self) -> int:
        """SIGTERM, as an operator stops it."""
        self.up.clear()
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)

    def tail(self) -> str:
        """The end of its log."""
        return "\n".join(json.dumps(line) for line in self.log[-20:])

    def defects(self) -> list[str]:
        """What it logged of requests that no code of its own answers."""
        failed = (line for line in self.log if line.get("code") == "internal_error")
        return [f"{line['method']} {line['route']}: {line['error_type']}" for line in failed]

    def _collect(self, process: "subprocess.Popen[bytes]") -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                try:
                    self.log.append(json.loads(line))
                except ValueError:
                    self.log.append({"text": line.decode(errors="replace").rstrip()})


def _lives(process: psutil.Process) -> bool:
    return bool(process.is_running()) and process.status() != psutil.STATUS_ZOMBIE


def _group_lives(group: int) -> bool:
    for process in psutil.process_iter():
        try:
            if os.getpgid(process.pid) == group and _lives(process):
                return True
        except (ProcessLookupError, psutil.NoSuchProcess):
            continue
    return False
