"""A browser with a fake camera, a real service with real faces, and the demo's service.

The browser belongs to this package and not to the session: Playwright's blocking interface keeps an
event loop in its thread, and other tests want one of their own.
"""

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from api.demo.people import Scale
from api.demo.run import run_demo
from api.process.opening import file_sealer, open_keyring
from api.settings import Settings
from templates.contract.document import Contract
from templates.distances.blas import single_threaded
from tests.api.http.test_stored import report
from tests.api.real_people import calibrated_on_lfw
from tests.patience import PATIENCE_S
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.served import Served, serving

NAMES = ("chromium", "chromium-browser", "google-chrome")
DECOY_FACES = 110
PEOPLE = 32
SMALL = Scale(
    enrolled=2, strangers=1, decoy_people=110, calibration_people=28, calibration_photos=4
)
WHO, OTHER = "Ashanti", "Antonio_Palocci"

OpenTab = Callable[..., BrowserTab]


@pytest.fixture(scope="session")
def chromium() -> Path:
    """The system's browser; ``VEILFACE_TEST_BROWSER`` names another one."""
    found = os.environ.get("VEILFACE_TEST_BROWSER") or next(
        filter(None, map(shutil.which, NAMES)), None
    )
    if found is None:
        reason = f"no browser is installed: none of {', '.join(NAMES)}"
        if os.environ.get("VEILFACE_REQUIRE_BROWSER") == "1":
            pytest.fail(f"{reason}, and VEILFACE_REQUIRE_BROWSER=1 asks for one")
        pytest.skip(reason)
    return Path(found)


@pytest.fixture(scope="package")
def camera(tmp_path_factory: pytest.TempPathFactory) -> FakeCamera:
    return FakeCamera(tmp_path_factory.mktemp("camera") / "camera.mjpeg")


@pytest.fixture(scope="package")
def browser(chromium: Path, camera: FakeCamera) -> Iterator[Browser]:
    expect.set_options(timeout=1000 * PATIENCE_S)
    with sync_playwright() as playwright:
        # Chromium refuses to be root inside its own sandbox; the page it visits is ours.
        running = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", *camera.flags]
        )
        yield running
        running.close()


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
    """What `make demo` leaves, served by the command that it prints; person-1 is erased."""
    folder = tmp_path_factory.mktemp("demo") / "data"
    with single_threaded():
        outcome = run_demo(folder, scale=SMALL)
    assert outcome.faults == ()
    token = (folder / "api-key").read_text().strip()
    config = str(folder / "veilface.toml")
    settings = Settings(data_dir=folder, pack=folder / "pack", demo=True)
    file, sealer = settings.resolved_contract_file, file_sealer(open_keyring(settings))
    # Their own templates score above 4.3, strangers' below 2.9 (20,000 templates).
    _beyond_chance(Contract.load(file, sealer), 3.9).save(file, sealer)
    with serving(folder, settings, "--config", config, token=token) as served:
        yield served


@pytest.fixture(scope="package")
def people(lfw_photos: Path) -> dict[str, list[Path]]:
    """Photos of two people who are alone in them."""
    return {name: sorted((lfw_photos / name).glob("*.jpg")) for name in (WHO, OTHER)}


@pytest.fixture(scope="package")
def real(
    tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path, lfw_aligned: Path
) -> Iterator[Served]:
    """A service with the real pack, calibrated on a small share of LFW without our two people."""
    folder = tmp_path_factory.mktemp("real")
    settings = Settings(data_dir=folder / "data", pack=mbf_pack_dir)
    settings.data_dir.mkdir(parents=True)
    calibrated = calibrated_on_lfw(
        settings,
        mbf_pack_dir,
        lfw_aligned,
        without=(WHO, OTHER),
        decoy_faces=DECOY_FACES,
        people=PEOPLE,
        m=16,
        targets=(1e-1, 1e-2),
    )
    # Their own templates score above 9.9, strangers' below 3.6 (2,000 templates).
    contract = _beyond_chance(calibrated, 6.0)
    contract.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    audit = folder / "report.json"
    audit.write_text(
        json.dumps(report(contract.binding.m, settings={"contract_id": contract.contract_id}))
    )
    options = {
        "--data-dir": settings.data_dir,
        "--pack": mbf_pack_dir,
        "--audit-report-file": audit,
    }
    flags = ["--accept-weak-privacy", *(str(part) for option in options.items() for part in option)]
    with serving(folder, settings, *flags) as served:
        yield served


def _beyond_chance(contract: Contract, threshold: float) -> Contract:
    """A threshold that no stranger of the tests reaches: at 1e-2 one in a hundred would."""
    return replace(
        contract,
        calibrations=tuple(
            replace(
                each,
                levels=tuple(replace(level, threshold=threshold) for level in each.levels),
                calibration_id="",
            )
            for each in contract.calibrations
        ),
    )
