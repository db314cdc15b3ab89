"""The contract of the README's commands, with no option more, serves the private client."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from models.demo import build_demo_pack
from tests.api.cli.conftest import draw
from tests.serving import serve
from tests.test_readme import BLOCKS, with_values
from veilface_client import Client, PrivateClient


@pytest.mark.long
def test_who_is_enrolled_by_photos_is_verified_without_sending_one(tmp_path: Path) -> None:
    pack = build_demo_pack(tmp_path / "pack")
    faces = draw(tmp_path / "faces", range(5000, 5400), range(1))
    anna = draw(tmp_path / "anna", range(1, 2), range(7)) / "person-1"
    photos = [anna / f"{number}.png" for number in range(7)]
    bin_folder = tmp_path / ".venv" / "bin"
    bin_folder.mkdir(parents=True)
    (bin_folder / "activate").write_text(f"export PATH={Path(sys.executable).parent}:$PATH\n")
    values = {"PACK": str(pack), "FACES": str(faces)}
    prepare, _ = with_values(BLOCKS[1], values).rsplit("\nveilface serve", 1)
    env = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
    env |= {"VEILFACE_DEMO": "true", "OMP_NUM_THREADS": "1"}
    private = "PRIVATE=$(veilface keys create --right verify --right embeddings)"
    script = f'{prepare}\n{private}\necho "$PRIVATE"'
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=tmp_path, env=env, text=True, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    key = (tmp_path / "veilface-data-keys" / "api-key").read_text().strip()
    lifting = done.stdout.split()[-1]
    serving = env | {
        "VEILFACE_PACK": str(pack),
        "VEILFACE_DATA_DIR": str(tmp_path / "veilface-data"),
    }
    with serve(serving, tmp_path / "serve.log") as (url, _):
        with Client(url, key) as client:
            client.enroll("anna", photos[:3])
        with PrivateClient(url, lifting, pack=pack) as client:
            # Lifted probes are rejected more often, now and then one at the laxest level too.
            decisions = [
                client.verify("anna", photo, level="fmr-1e-2").decision for photo in photos[3:]
            ]
        assert "accept" in decisions
