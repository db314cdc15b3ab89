"""A browser with a fake camera, a real service with real faces, and the demo's service.

The browser belongs to this package and not to the session: Playwright's blocking interface keeps an
event loop in its thread, and other tests want one of their own.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from models.pack import ModelPack
from tests.clients.conftest import Running
from tests.patience import PATIENCE_S
from tests.required import absent
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.deployments import (
    OTHER,
    WHO,
    demo_service,
    moving_service,
    private_service,
    real_service,
)
from tests.web.served import Served

NAMES = ("chromium", "chromium-browser", "google-chrome")
OpenTab = Callable[..., BrowserTab]


def installed_browser() -> str | None:
    """Find the system's browser; ``VEILFACE_TEST_BROWSER`` names another one."""
    return os.environ.get("VEILFACE_TEST_BROWSER") or next(
        filter(None, map(shutil.which, NAMES)), None
    )


@pytest.fixture(scope="session")
def chromium() -> Path:
    """The browser of :func:`installed_browser`."""
    found = installed_browser()
    if found is None:
        reason = f"no browser is installed: none of {', '.join(NAMES)}"
        absent(reason, "VEILFACE_REQUIRE_BROWSER")
    return Path(found)


@pytest.fixture(scope="package")
def camera(tmp_path_factory: pytest.TempPathFactory) -> FakeCamera:
    return FakeCamera(tmp_path_factory.mktemp("camera") / "camera.mjpeg")


@contextmanager
def running_browser(chromium: Path, *flags: str) -> Iterator[Browser]:
    """Run a browser. Playwright runs no second one in the same process."""
    expect.set_options(timeout=1000 * PATIENCE_S)
    with sync_playwright() as playwright:
        # Chromium refuses to be root inside its own sandbox; the page it visits is ours.
        running = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", *flags]
        )
        yield running
        running.close()


@pytest.fixture(scope="package")
def browser(chromium: Path, camera: FakeCamera) -> Iterator[Browser]:
    with running_browser(chromium, *camera.flags) as running:
        yield running


@pytest.fixture
def open_tab(browser: Browser) -> Iterator[OpenTab]:
    """Open a tab on a service; at its end, every one of them must have been clean."""
    opened: list[tuple[Any, BrowserTab]] = []

    def open_one(served: Served, *, sign_in: str | None = "", **options: Any) -> BrowserTab:
        context = browser.new_context(
            viewport={"width": options.pop("width", 1280), "height": 800}, **options
        )
        tab = BrowserTab.of(context, served.url + "/")
        opened.append((context, tab))
        if sign_in is not None:
            tab.sign_in(sign_in or served.token)
        return tab

    yield open_one
    try:
        for _, tab in opened:
            tab.assert_clean()
    finally:
        for context, _ in opened:
            context.close()


@pytest.fixture(scope="package")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with demo_service(tmp_path_factory.mktemp("demo") / "data") as served:
        yield served


@pytest.fixture(scope="package")
def local(demo: Served) -> Served:
    """The demo's service under a name: an IP address has no passkeys."""
    return replace(demo, url=demo.url.replace("127.0.0.1", "localhost"))


@pytest.fixture(scope="package")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with moving_service(tmp_path_factory.mktemp("moving")) as served:
        yield served


@pytest.fixture(scope="package")
def people(lfw_photos: Path) -> dict[str, list[Path]]:
    """Photos of two people who are alone in them."""
    return {name: sorted((lfw_photos / name).glob("*.jpg")) for name in (WHO, OTHER)}


@pytest.fixture(scope="package")
def real(
    tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path, lfw_aligned: Path
) -> Iterator[Served]:
    with real_service(tmp_path_factory.mktemp("real"), mbf_pack_dir, lfw_aligned) as served:
        yield served


@pytest.fixture(scope="package")
def pack(mbf_pack_dir: Path) -> ModelPack:
    return ModelPack.load(mbf_pack_dir, threads=1)


@pytest.fixture(scope="package")
def running(tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path) -> Iterator[Running]:
    with private_service(tmp_path_factory.mktemp("javascript"), mbf_pack_dir) as service:
        yield service
