"""Running services for the client: one with the tiny pack, one without any."""

import dataclasses
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from benchmarks.deployment import service as serve
from tests.api.deployment import Deployment, deploy, environment_of
from tests.ports import free_port

VEILFACE = Path(sys.executable).with_name("veilface")


@dataclass(frozen=True)
class Running:
    """A service, where it is, and what it was made of."""

    url: str
    deployment: Deployment

    @property
    def port(self) -> int:
        """Its port on this machine."""
        return int(self.url.rsplit(":", 1)[1])

    @property
    def pack(self) -> Path:
        """The pack of the contract, whether the service has it or not."""
        return self.deployment.settings.data_dir.parent / "tiny"


@contextmanager
def started(deployment: Deployment, folder: Path) -> Iterator[Running]:
    """``veilface serve`` as a process of its own."""
    ours = {name: value for name, value in os.environ.items() if not name.startswith("VEILFACE_")}
    env = ours | environment_of(deployment.settings) | {"OMP_NUM_THREADS": "1"}
    with serve(env, workers=1, log=folder / "serve.log", port=free_port()) as url:
        yield Running(url, deployment)


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service with the tiny pack, on SQLite; five rejections lock a subject."""
    folder = tmp_path_factory.mktemp("service")
    deployment = deploy(folder, rate_limit_key="off", rate_limit_address="off")
    deployment.allow_templates()
    with started(deployment, folder) as running:
        yield running


@pytest.fixture(scope="session")
def packless(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """A service that has no model pack at all."""
    folder = tmp_path_factory.mktemp("packless")
    deployment = deploy(folder)
    deployment.allow_templates()
    settings = deployment.settings.model_copy(update={"pack": None})
    with started(dataclasses.replace(deployment, settings=settings), folder) as running:
        yield running


REMEMBERING = """#!{python} -IS
import hashlib, json, os, pathlib, subprocess, sys
at = sys.argv.index("--")
options, photos = sys.argv[1:at], []
for name in sys.argv[at + 1 :]:
    with open(name, "rb") as file:
        photos.append(file.read())
paths = ("--pack=", "--contract=", "--generator=")
asked = [each for each in options if not each.startswith(paths)]
asked += [pathlib.Path(each).stem for each in options if each.startswith("--contract=")]
asked += [hashlib.sha256(photo).hexdigest() for photo in photos]
kept = pathlib.Path({folder!r}, hashlib.sha256(json.dumps(asked).encode()).hexdigest())
if not kept.exists():
    ends = []
    for photo in photos:
        assert len(photo) < 65536, "a pipe takes it at once"
        reading, writing = os.pipe()
        os.write(writing, photo)
        os.close(writing)
        ends.append(reading)
    names = [f"/dev/fd/{{end}}" for end in ends]
    done = subprocess.run(
        [{veilface!r}, *options, "--", *names], pass_fds=ends, stdout=subprocess.PIPE, check=True
    )
    kept.write_bytes(done.stdout)
sys.stdout.write(kept.read_text())
"""


@pytest.fixture(scope="session")
def remembering(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``veilface lift`` that lifts the same photos under the same contract once, then repeats it.

    Its first lift is a real one, by pipes; a process of the real command takes seconds.
    """
    folder = tmp_path_factory.mktemp("remembering")
    (folder / "lifts").mkdir()
    command = folder / "veilface"
    command.write_text(
        REMEMBERING.format(
            python=sys.executable, folder=str(folder / "lifts"), veilface=str(VEILFACE)
        )
    )
    command.chmod(0o755)
    return command


@pytest.fixture
def token(service: Running) -> str:
    """The bootstrap key: all rights."""
    return service.deployment.token
