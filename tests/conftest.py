"""Fixtures shared by all packages: the real models and faces, where they are present."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# A busy machine is no failure: no example has a deadline, and none is too slow to be drawn.
settings.register_profile("veilface", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("veilface")

DEFAULT_SHARED_DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


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
        if os.environ.get("VEILFACE_REQUIRE_DATA") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    return root


@pytest.fixture(scope="session")
def mbf_pack_dir(shared_data: Path) -> Path:
    """SCRFD-500M and the 512-d ArcFace MobileFaceNet."""
    return shared_data / "packs" / "w600k_mbf"


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
