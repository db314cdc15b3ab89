"""A worker decides with NumPy alone: a compiler would take a third of its memory.

Nor does it load the attacks or the demo.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.api.deployment import deploy, environment_of
from tests.patience import PATIENCE_S

SERVE = """
import sys
from fastapi.testclient import TestClient
from api.http.app import create_app
from api.settings import load_settings
from tests.api.deployment import bearer, images, photo

with TestClient(create_app(load_settings()), headers=bearer(sys.argv[1])) as client:
    photos = images(photo(1), photo(1, 1))
    assert client.put("/v1/subjects/ada/enrollment", files=photos).status_code == 201
    sent = images(photo(1, 2), name="image")
    answer = client.post("/v1/subjects/ada/verify", files=sent)
    assert answer.json()["decision"] == "accept", answer.json()
unwanted = {"llvmlite", "numba", "torch", "attacks", "api.demo"}
print(sorted(unwanted & sys.modules.keys()))
"""


@pytest.mark.long
def test_a_worker_loads_no_compiler_no_attack_and_no_demo(tmp_path: Path) -> None:
    deployment = deploy(tmp_path)
    assert deployment.contract.takes_lifted_probes
    done = subprocess.run(
        [sys.executable, "-c", SERVE, deployment.token],
        env=os.environ | environment_of(deployment.settings),
        cwd=Path(__file__).resolve().parents[3],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split("\n")[-2] == "[]"
