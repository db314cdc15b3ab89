"""``veilface serve`` as a process, with what it wrote."""

import contextlib
import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx

from tests.api.deployment import Deployment, environment_of
from tests.patience import PATIENCE_S, wait_until


class Server:
    """A service; ``verify`` is httpx's, for a certificate of its own."""

    def __init__(
        self, deployment: Deployment, folder: Path, verify: Any = True, **environment: str
    ) -> None:
        self.deployment = deployment
        self.log = folder / "stderr"
        self.port = deployment.settings.port
        scheme = "http" if deployment.settings.tls_certificate is None else "https"
        self.url = f"{scheme}://127.0.0.1:{self.port}"
        self._verify = verify
        with self.log.open("wb") as stderr:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "veilface", "serve"],
                cwd=Path(__file__).resolve().parents[2],
                env={**environment_of(deployment.settings), "OMP_NUM_THREADS": "1", **environment},
                stderr=stderr,
            )

    def __enter__(self) -> "Server":
        try:
            self.wait()
        except BaseException:
            self.kill()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def wait(self) -> None:
        def ready() -> bool:
            assert self.process.poll() is None, self.log.read_text()
            with contextlib.suppress(httpx.TransportError):
                return self.get("/health/ready").status_code == 200
            return False

        wait_until(ready, what="a server that is ready")

    def get(self, path: str, **options: Any) -> httpx.Response:
        return httpx.get(self.url + path, timeout=PATIENCE_S, verify=self._verify, **options)

    def lines(self) -> list[dict[str, Any]]:
        """What it logged, in whole lines."""
        whole = self.log.read_text().splitlines(keepends=True)
        return [json.loads(line) for line in whole if line[0] == "{" and line[-1] == "\n"]

    def in_flight(self) -> float:
        """How many requests the workers are answering; needs the setting ``open_metrics``."""
        text = self.get("/metrics").text
        return float(re.findall(r"^veilface_requests_in_flight (.+)$", text, flags=re.M)[0])

    def stop(self) -> int:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE_S)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
