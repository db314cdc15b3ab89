"""Everybody can use it: axe, the keyboard alone, narrow screens, light and dark."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from models.demo import DEMO_NOTICE
from tests.web import walk
from tests.web.access import assert_accessible, findings
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import OTHER, WHO
from tests.web.served import Served

pytestmark = pytest.mark.long

VIEWS = ("Verify", "Enroll", "People", "Service")


@pytest.mark.parametrize("visit", walk.DEMO_WALKS)
def test_axe_finds_nothing_in_any_state_of_any_view(
    open_tab: OpenTab, demo: Served, visit: Callable[[BrowserTab, Served], Iterator[str]]
) -> None:
    tab = open_tab(demo, sign_in=None)
    mark = tab.page.get_by_text(DEMO_NOTICE, exact=True).first
    for name in visit(tab, demo):
        assert_accessible(tab, name)
        expect(mark).to_be_in_viewport()


def test_axe_finds_nothing_where_a_holder_key_is_asked(open_tab: OpenTab, local: Served) -> None:
    tab = open_tab(local, sign_in=None)
    for name in walk.walk_passkeys(tab, local):
        assert_accessible(tab, name)


def test_axe_finds_nothing_while_the_head_moves(open_tab: OpenTab, moving: Served) -> None:
    tab = open_tab(moving, sign_in=None)
    for name in walk.walk_challenge(tab, moving):
        assert_accessible(tab, name)


def test_axe_finds_nothing_where_faces_are_real(
    open_tab: OpenTab, real: Served, camera: FakeCamera, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(real, sign_in=None)
    for name in walk.walk_real(tab, real, camera, people[WHO], people[OTHER]):
        assert_accessible(tab, name)


def test_axe_finds_a_fault_that_is_planted(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.page.evaluate("document.querySelector('label[for]').removeAttribute('for')")
    assert any(name == "label" for name, _ in findings(tab.page))


def test_the_keyboard_alone_is_enough(open_tab: OpenTab, demo: Served) -> None:
    walk.enroll(demo, "by-key", "person-2", shots=3)
    tab = open_tab(demo, sign_in=None)
    page = tab.page
    page.goto(tab.url)
    page.wait_for_selector("#key")
    press_until(page, "#key")
    page.keyboard.type(demo.token)
    page.keyboard.press("Enter")
    heading = page.get_by_role("heading", level=1)
    expect(heading).to_have_text("Verify")
    expect(heading).to_be_focused()
    press_until(page, "input[type=text]")
    page.keyboard.type("by-key")
    press_until(page, "button.shot")
    page.keyboard.press("Enter")
    tab.good(1)
    press_until(page, "button[type=submit]")
    page.keyboard.press("Enter")
    expect(page.locator(".verdict")).to_be_visible()
    for view in VIEWS[1:]:
        press_until(page, f"nav a[data-view={view.lower()}]")
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline == "solid"
        page.keyboard.press("Enter")
        expect(heading).to_be_focused()
        expect(page).to_have_title(f"{view} · Veilface")
    press_until(page, ".skip")
    page.keyboard.press("Enter")
    expect(page.get_by_role("main")).to_be_focused()
    expect(heading).to_have_text("Service")
    tab.open("People")
    page.wait_for_selector("li.person")
    press_until(page, "button[aria-label='Erase by-key']")
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="Erase by-key")).to_be_focused()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(page.locator(".verdict")).to_contain_text("Erased by-key")
    expect(page.locator(".verdict")).to_be_focused()
    press_until(page, "#who button")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_focused()


def press_until(page: Page, selector: str) -> None:
    """Press Tab until an element has the focus; a page has fewer than a hundred stops."""
    for _ in range(100):
        page.keyboard.press("Tab")
        if page.evaluate("s => document.activeElement.matches(s)", selector):
            return
    pytest.fail(f"Tab does not reach {selector}")
