"""The compiler of the kernels takes a third of a worker's memory: who needs none loads none."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import pytest

from api.process.runtime import file_sealer, open_keyring
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
print("numba" in sys.modules)
"""


@pytest.mark.long
@pytest.mark.parametrize("mode", ["p2s", "s2s"])
def test_the_compiler_is_loaded_where_lifted_probes_are_taken(tmp_path: Path, mode: str) -> None:
    deployment = deploy(tmp_path)
    if mode == "p2s":
        points = deployment.contract.calibrations[:1]
        contract = dataclasses.replace(deployment.contract, calibrations=points)
        assert not contract.takes_lifted_probes
        sealer = file_sealer(open_keyring(deployment.settings))
        contract.save(deployment.settings.resolved_contract_file, sealer)
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
    assert done.stdout.split()[-1] == str(mode == "s2s")
