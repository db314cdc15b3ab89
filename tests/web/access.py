"""Is the page, as it stands, of use to everybody: axe, and nothing wider than the screen."""

import os
from pathlib import Path
from typing import Any

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from tests.web.browser_tab import BrowserTab

SHOTS = os.environ.get("VEILFACE_TEST_SCREENSHOTS")
"""A folder to keep pictures of the views in, for a person to look at."""


def serious(page: Page) -> list[tuple[str, str]]:
    """What axe calls a serious or critical violation on the page as it stands."""
    found: list[dict[str, Any]] = Axe().run(page).response["violations"]
    return [
        (each["id"], each["nodes"][0]["html"])
        for each in found
        if each["impact"] in ("serious", "critical")
    ]


def shot(tab: BrowserTab, name: str) -> None:
    if SHOTS:
        tab.page.screenshot(path=Path(SHOTS) / f"{name}.png", full_page=True)


def assert_accessible(tab: BrowserTab, name: str) -> None:
    assert serious(tab.page) == [], name
    wide = tab.page.evaluate("document.documentElement.scrollWidth - innerWidth")
    assert wide <= 0, f"{name} scrolls sideways by {wide} px"
    shot(tab, name)
