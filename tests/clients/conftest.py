"""Running services for the client: one with the tiny pack, one without any."""

import dataclasses
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.api.deployment import Deployment, deploy, environment_of
from tests.serving import serve

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
    with serve(env, folder / "serve.log") as (url, _):
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


@pytest.fixture
def token(service: Running) -> str:
    """The bootstrap key: all rights."""
    return service.deployment.token
