"""Schemathesis against the running service: cases made from its own OpenAPI document.

With a key that has all rights, with a key that has none but ``verify``, and without a key.
"""

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.server_process import Server
from tests.patience import PATIENCE_S
from tests.ports import free_port

CONFIG = """\
[checks]
# A value that the schema allows may still show no face, or be no template of this contract.
positive_data_acceptance.expected-statuses = [
  "2xx", "400", "401", "403", "404", "409", "413", "422", "423"
]
# Too many photos are refused with 413.
negative_data_rejection.expected-statuses = [
  "400", "401", "403", "404", "405", "409", "413", "415", "422", "423", "429"
]
"""

EXCLUDED = (
    "use_after_free",  # what came of a token is known after its subject was erased
    "allow_header_conformance",  # `import` may be a subject's id: its path takes more methods
)


@dataclass(frozen=True)
class Run:
    """What one run of schemathesis did."""

    name: str
    status: int
    cases: int
    output: str


@contextmanager
def service(folder: Path, **settings: Any) -> Iterator[tuple[Server, Deployment]]:
    """A service of two workers with one person enrolled; limits that would end the run are off."""
    deployment = deploy(
        folder,
        port=free_port(),
        workers=2,
        compute_slots=1,
        **{
            "rate_limit_key": "off",
            "rate_limit_address": "off",
            "lockout_after": 0,
            **settings,
        },
    )
    with Server(deployment, folder) as server:
        with httpx.Client(
            base_url=server.url, headers=bearer(deployment.token), timeout=PATIENCE_S
        ) as client:
            answer = client.put("/v1/subjects/alice/enrollment", files=images(photo(1)))
            assert answer.status_code == 201, answer.text
        yield server, deployment
        server.stop()


def schemathesis(
    name: str, url: str, folder: Path, *, headers: Mapping[str, str], examples: int, seed: int
) -> Run:
    """Run the command line of schemathesis with all checks; count its cases."""
    folder.mkdir(parents=True, exist_ok=True)
    config = folder / "schemathesis.toml"
    config.write_text(CONFIG)
    report = folder / f"{name}.ndjson"
    command = [
        sys.executable, "-m", "schemathesis.cli", "--config-file", str(config),
        "run", f"{url}/v1/openapi.json",
        "--checks", "all", "--exclude-checks", ",".join(EXCLUDED),
        "--max-examples", str(examples), "--seed", str(seed),
        "--continue-on-failure", "--generation-database", "none", "--no-color",
        "--suppress-health-check", "all", "--request-timeout", "30", "--warnings", "off",
        "--report-ndjson-path", str(report),
        *(part for item in headers.items() for part in ("--header", ": ".join(item))),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return Run(name, done.returncode, count_cases(report), done.stdout + done.stderr)


def count_cases(report: Path) -> int:
    """Requests that a run sent, by its report of events."""
    count = 0
    with report.open(encoding="utf-8") as lines:
        for line in lines:
            event = json.loads(line)
            recorder = event.get("ScenarioFinished", {}).get("recorder", {})
            count += len(recorder.get("interactions", {}))
    return count


def run_all(server: Server, deployment: Deployment, folder: Path, *, examples: int, seed: int
            ) -> list[Run]:  # fmt: skip
    """One run for each kind of caller."""
    callers = {
        "all-rights": bearer(deployment.token),
        "verify-only": bearer(deployment.key("verify")),
        "nobody": {},
    }
    return [
        schemathesis(name, server.url, folder, headers=headers, examples=examples, seed=seed)
        for name, headers in callers.items()
    ]
