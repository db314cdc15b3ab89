"""Fixtures shared by all packages: the real models and faces, where they are present."""

import gc
import os
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from tests.required import absent
from tests.seeded import drawn_of

# A busy machine is no failure: no example has a deadline, and none is too slow to be drawn. Every
# run draws the same examples; `--hypothesis-profile=default` draws others.
settings.register_profile(
    "veilface",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("veilface")

# What tests import stays to the end: looking through all of it for garbage, again and again, takes
# longer than many of them.
gc.disable()


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()
    gc.enable()


DEFAULT_SHARED_DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
) -> Generator[None, object, object]:
    """Draw what a fixture draws of its name, whoever asks for it first."""
    seed = f"{fixturedef.baseid}::{fixturedef.argname}[{getattr(request, 'param_index', 0)}]"
    with drawn_of(seed):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Draw what a test draws of its name; the tests of keys are tests of chance itself."""
    if "tests/templates/keys" in item.path.as_posix():
        return (yield)
    with drawn_of(item.nodeid):
        return (yield)


@pytest.fixture(autouse=True)
def the_environment_stays() -> Iterator[None]:
    """Fail a test that leaves variables behind: the next one would read them as settings.

    What fixtures of a wider scope set is not seen.
    """

    def ours() -> set[tuple[str, str]]:
        prefixes = ("VEILFACE_", "PROMETHEUS_")  # libraries set others when they are imported
        return {(k, v) for k, v in os.environ.items() if k.startswith(prefixes)}

    before = ours()
    yield
    assert {name for name, _ in before ^ ours()} == set()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with real packs and real faces (``VEILFACE_TEST_DATA`` overrides where)."""
    root = Path(os.environ.get("VEILFACE_TEST_DATA", DEFAULT_SHARED_DATA))
    if not (root / "README.md").exists():
        reason = f"real models and faces are absent: {root} does not exist"
        absent(reason, "VEILFACE_REQUIRE_DATA")
    return root


@pytest.fixture(scope="session")
def mbf_pack_dir(shared_data: Path) -> Path:
    """SCRFD-500M and the 512-d ArcFace MobileFaceNet."""
    return shared_data / "packs" / "w600k_mbf"


@pytest.fixture(scope="session")
def minifasnet_pack_dir(
    mbf_pack_dir: Path, shared_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The former pack with the two MiniFASNet liveness graphs."""
    folder = tmp_path_factory.mktemp("minifasnet") / "pack"
    folder.mkdir()
    for source in (mbf_pack_dir, shared_data / "packs" / "liveness"):
        for file in source.glob("*.onnx"):
            (folder / file.name).symlink_to(file)
    return folder


@pytest.fixture(scope="session")
def yunet_pack_dir(shared_data: Path) -> Path:
    """YuNet and the 128-d MobileFaceNet."""
    return shared_data / "packs" / "yunet_mobilefacenet128"


@pytest.fixture(scope="session")
def lfw_photos(shared_data: Path) -> Path:
    """80 people with 5 unaligned LFW photos each."""
    return shared_data / "lfw" / "photos"


@pytest.fixture(scope="session")
def lfw_aligned(shared_data: Path) -> Path:
    """The aligned crops of LFW view 2, with ``pairs.txt``."""
    return shared_data / "lfw" / "aligned112"


@pytest.fixture(scope="session")
def fairface(shared_data: Path) -> Path:
    """FairFace subset: 5,000 training and 1,500 validation faces with labels."""
    return shared_data / "fairface"
