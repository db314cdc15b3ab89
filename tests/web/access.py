"""Is the page, as it stands, of use to everybody: axe, and nothing wider than the screen."""

from collections.abc import Iterator
from itertools import product
from typing import Any, Literal

from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from tests.web.browser_tab import BrowserTab

Scheme = Literal["light", "dark"]
Size = tuple[int, int]

SIZES: tuple[Size, ...] = ((1280, 800), (390, 844))
SCHEMES: tuple[Scheme, ...] = ("light", "dark")
NARROWEST = (360, 640)


def findings(page: Page) -> list[tuple[str, str]]:
    """What axe finds on the page as it stands, of whatever impact."""
    found: list[dict[str, Any]] = Axe().run(page).response["violations"]
    return [(each["id"], each["nodes"][0]["html"]) for each in found]


def looks(page: Page) -> Iterator[str]:
    """Show the page as it stands at each size, light and dark; name each, and leave the first."""
    every = list(product(SIZES, SCHEMES))
    for size, scheme in every:
        _show(page, size, scheme)
        yield f"{size[0]}-{scheme}"
    _show(page, *every[0])


def _show(page: Page, size: Size, scheme: Scheme) -> None:
    page.set_viewport_size({"width": size[0], "height": size[1]})
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")


def assert_accessible(tab: BrowserTab, name: str) -> None:
    """Nothing for axe to find, however the page is looked at."""
    for look in looks(tab.page):
        assert findings(tab.page) == [], f"{name}, {look}"
        _assert_fits(tab.page, f"{name}, {look}")
    _show(tab.page, NARROWEST, "light")
    _assert_fits(tab.page, f"{name}, at the narrowest")
    _show(tab.page, SIZES[0], "light")
    assert "[object " not in tab.page.locator("body").inner_text(), name


def _assert_fits(page: Page, name: str) -> None:
    wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
    assert wide <= 0, f"{name} scrolls sideways by {wide} px"
