"""Is the page, as it stands, of use to everybody: axe, and nothing wider than the screen."""

from typing import Any

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from tests.web.browser_tab import BrowserTab


def findings(page: Page) -> list[tuple[str, str]]:
    """What axe finds on the page as it stands, of whatever impact."""
    found: list[dict[str, Any]] = Axe().run(page).response["violations"]
    return [(each["id"], each["nodes"][0]["html"]) for each in found]


def assert_accessible(tab: BrowserTab, name: str) -> None:
    assert findings(tab.page) == [], name
    assert "[object " not in tab.page.locator("body").inner_text(), name
    wide = tab.page.evaluate("document.documentElement.scrollWidth - innerWidth")
    assert wide <= 0, f"{name} scrolls sideways by {wide} px"
