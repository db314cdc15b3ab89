"""``veilface serve`` as a process group of its own, with what it wrote."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx
import psutil

from tests.api.deployment import Deployment, environment_of
from tests.patience import PATIENCE_S, wait_until

ROOT = Path(__file__).resolve().parents[2]


class Server:
    """One deployment's service on its port; it may be started as often as it ended.

    Parameters
    ----------
    verify
        As of httpx, for a certificate of its own.
    within
        Program, with its arguments, that runs it somewhere else than here.

    Attributes
    ----------
    up
        Whether all workers serve, for threads that wait for it.
    """

    def __init__(
        self,
        deployment: Deployment,
        folder: Path,
        *,
        verify: Any = True,
        within: Sequence[str] = (),
        **environment: str,
    ) -> None:
        self.deployment = deployment
        self.port = deployment.settings.port
        self.log = folder / f"{deployment.settings.host}-{self.port}.log"
        scheme = "http" if deployment.settings.tls_certificate is None else "https"
        self.url = f"{scheme}://{deployment.settings.host}:{self.port}"
        self.up = threading.Event()
        self.starts = 0
        self.within = within
        self.environment = {
            **{
                name: value
                for name, value in os.environ.items()
                if not name.startswith("VEILFACE_")
            },
            **environment_of(deployment.settings),
            "OMP_NUM_THREADS": "1",
            "TMPDIR": str(folder),
            **environment,
        }
        self._verify = verify
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Server":
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
        with self.log.open("ab") as stderr:
            self._process = subprocess.Popen(
                [*self.within, sys.executable, "-m", "veilface", "serve"],
                cwd=ROOT,
                env=self.environment,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                start_new_session=True,
            )
        self.wait()
        self.up.set()

    def wait(self) -> None:
        """Return when as many workers as there should be have opened their runtime, and serve."""
        workers = self.deployment.settings.workers

        def ready() -> bool:
            assert self.process.poll() is None, self.tail()
            return (workers == 1 or len(self.workers()) >= workers) and self.is_ready()

        wait_until(ready, what="a server that is ready")

    def is_ready(self) -> bool:
        """Whether a worker says that it is ready."""
        # A worker that was killed may have taken the connection.
        with contextlib.suppress(httpx.TransportError):
            return self.get("/health/ready").status_code == 200
        return False

    def get(self, path: str, **options: Any) -> httpx.Response:
        return httpx.get(
            self.url + path, timeout=PATIENCE_S, verify=self._verify, trust_env=False, **options
        )

    @property
    def process(self) -> "subprocess.Popen[bytes]":
        """The first process, which starts the workers."""
        assert self._process is not None
        return self._process

    def workers(self) -> list[int]:
        """Process ids of the workers that live and have opened their runtime."""
        opened = {line["pid"] for line in self.lines() if line["event"] == "started"}
        try:
            children = psutil.Process(self.process.pid).children()
            return [each.pid for each in children if each.pid in opened and _lives(each)]
        except psutil.NoSuchProcess:
            return []

    def lines(self) -> list[dict[str, Any]]:
        """What it logged, in whole lines."""
        whole = self.log.read_text().splitlines(keepends=True)
        return [json.loads(line) for line in whole if line[0] == "{" and line[-1] == "\n"]

    def tail(self) -> str:
        """The end of its log."""
        return "\n".join(self.log.read_text().splitlines()[-20:])

    def defects(self) -> list[str]:
        """What it logged of requests that no code of its own answers."""
        failed = (line for line in self.lines() if line.get("code") == "internal_error")
        return [f"{line['method']} {line['route']}: {line['error_type']}" for line in failed]

    def in_flight(self) -> float:
        """How many requests the workers are answering; needs the setting ``open_metrics``."""
        text = self.get("/metrics").text
        return float(re.findall(r"^veilface_requests_in_flight (.+)$", text, flags=re.M)[0])

    def stop(self) -> int:
        """SIGTERM, as an operator stops it; its exit status."""
        self.up.clear()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)

    def kill(self) -> None:
        """SIGKILL the first process and all workers at once, and wait until they are gone."""
        self.up.clear()
        if self._process is None:
            return
        group = self._process.pid
        with contextlib.suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)
        self._process.wait()
        wait_until(
            lambda: not _group_lives(group), what="the end of killed processes", every_s=0.01
        )


def _lives(process: psutil.Process) -> bool:
    return bool(process.is_running()) and process.status() != psutil.STATUS_ZOMBIE


def _group_lives(group: int) -> bool:
    for process in psutil.process_iter():
        with contextlib.suppress(ProcessLookupError, psutil.NoSuchProcess):
            if os.getpgid(process.pid) == group and _lives(process):
                return True
    return False
