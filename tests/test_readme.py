"""Every command of the README is run: here with real weights, or by CI."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest

from benchmarks.readme_results import readme_table, written_into
from models.errors import FaceError
from models.pack import ModelPack
from models.quality import QualityLimits
from tests.patience import PATIENCE_S, wait_until

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parent.parent
FENCE = re.compile(r"^```sh\n(.*?)^```", flags=re.M | re.S)
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = FENCE.findall(README)
EVALUATION = ROOT / "docs" / "evaluation.md"
PORT = 8421
KEPT = ("lfw.json", "lfw-wide.json", "lfw-plus.json")


def with_values(block: str, values: dict[str, str]) -> str:
    """The block with the newcomer's paths in place of the README's examples."""
    for name, value in values.items():
        block, found = re.subn(rf"^{name}=.*$", f"{name}={value}", block, flags=re.M)
        assert found == 1, f"the README no longer sets {name}"
    return block


def shell(script: str, folder: Path, env: dict[str, str]) -> str:
    """Run a script as bash would, stopping at the first failure; its output."""
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script],
        cwd=folder,
        env=env,
        text=True,
        capture_output=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, f"{script}\n{done.stderr}"
    return done.stdout


@pytest.fixture
def newcomer(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """An empty folder with the installed command on the path."""
    bin_folder = tmp_path / ".venv" / "bin"
    bin_folder.mkdir(parents=True)
    (bin_folder / "activate").write_text(f"export PATH={Path(sys.executable).parent}:$PATH\n")
    env = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
    return tmp_path, env


def some_faces(folder: Path, fairface: Path, count: int) -> Path:
    """The first training faces of FairFace in a folder of their own."""
    faces = folder / "faces"
    faces.mkdir()
    for photo in sorted((fairface / "train").glob("*.jpg"))[:count]:
        (faces / photo.name).symlink_to(photo)
    return faces


def test_the_first_block_is_what_ci_runs() -> None:
    commands = BLOCKS[0].split("\n")[:-1]
    assert commands == ["make demo", "make test"]
    ci = (ROOT / ".ci" / "run").read_text()
    assert all(command in ci for command in commands)


def test_the_real_path_from_weights_to_a_receipt(
    newcomer: tuple[Path, dict[str, str]], mbf_pack_dir: Path, fairface: Path, lfw_photos: Path
) -> None:
    folder, env = newcomer
    installed = str(Path(sys.executable).parent)
    path = [part for part in env["PATH"].split(os.pathsep) if part != installed]
    new_shell = {**env, "PATH": os.pathsep.join(path)}
    faces = some_faces(folder, fairface, 300)
    names = sorted(person for person in lfw_photos.iterdir() if person.is_dir())
    for index, photo in enumerate(somebody_alone(names, ModelPack.load(mbf_pack_dir)), start=1):
        (folder / f"anna{index}.jpg").symlink_to(photo)

    values = {"PACK": str(mbf_pack_dir), "FACES": str(faces)}
    prepare, serve = with_values(BLOCKS[1], values).rsplit("\nveilface serve", 1)
    said = shell(prepare, folder, new_shell)
    assert "Privacy: " in said
    assert "Accuracy: " in said
    assert (folder / "veilface-data-keys" / "api-key").read_text().startswith("vf_")
    assert (folder / "veilface-data-keys" / "master.key").is_file()
    assert not list((folder / "veilface-data").glob("*.key"))

    activate = ". .venv/bin/activate"
    server = subprocess.Popen(
        ["bash", "-c", f"{activate}\nexec veilface serve{serve}"],
        cwd=folder,
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_until_ready(server)
        calls = BLOCKS[2] + BLOCKS[4]
        script = calls.replace("curl ", "curl --silent --show-error --fail-with-body ")
        assert not shutil.which("veilface", path=new_shell["PATH"])
        answers = shell(script, folder, new_shell)
    finally:
        server.terminate()
        server.wait(timeout=PATIENCE_S)
    (answer,) = (json.loads(part) for part in re.findall(r'\{[^{}]*"decision"[^{}]*\}', answers))
    (shown,) = re.findall(r"^```json\n(.*?)^```", README, flags=re.M | re.S)
    example = json.loads(shown)
    assert {**example, **ids_of(answer)} == answer


def test_the_results_table_is_that_of_the_results_in_the_repository() -> None:
    folder = ROOT / "docs" / "results"
    results = [json.loads((folder / name).read_text(encoding="utf-8")) for name in KEPT]
    text = EVALUATION.read_text(encoding="utf-8")
    assert written_into(text, readme_table(results)) == text


def ids_of(answer: dict[str, str]) -> dict[str, str]:
    """What differs from call to call, and from contract to contract."""
    return {
        name: value
        for name, value in answer.items()
        if name.endswith("_id") or name.startswith("distance")
    }


def somebody_alone(people: list[Path], pack: ModelPack) -> list[Path]:
    """Five photos of a person that show nobody else and are as alike as a user's own."""
    for person in people:
        alone, embeddings = [], []
        for photo in sorted(person.glob("*.jpg")):
            try:
                sample = pack.embed_photo(photo.read_bytes(), quality=QualityLimits())
            except FaceError:
                continue
            alone.append(photo)
            embeddings.append(sample.embedding)
        if len(alone) >= 5 and np.min(np.array(embeddings) @ np.array(embeddings).T) > 0.5:
            return alone[:5]
    pytest.fail("nobody is alone in five photos that are alike")


def wait_until_ready(server: subprocess.Popen[bytes]) -> None:
    """Wait for the service of the README, on its own port."""

    def ready() -> bool:
        assert server.poll() is None, "veilface serve ended"
        with suppress(httpx.TransportError):
            answer = httpx.get(f"http://127.0.0.1:{PORT}/health/ready", timeout=PATIENCE_S)
            return answer.status_code == 200
        return False

    wait_until(ready, what="the service of the README")
