"""Everybody can use it: axe, the keyboard alone, narrow screens, light and dark."""

from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from models.demo import DEMO_NOTICE
from tests.web.access import assert_accessible, findings
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import OTHER, WHO
from tests.web.served import Served
from tests.web.walk import walk_demo, walk_real
from tests.web.walk_obstacles import walk_challenge, walk_obstacles, walk_passkeys

pytestmark = pytest.mark.long

VIEWS = ("Verify", "Enroll", "People", "Service")


def test_axe_finds_nothing_in_any_state_of_any_view(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=None)
    seen = set()
    mark = tab.page.get_by_text(DEMO_NOTICE, exact=True).first
    for name in walk_demo(tab, demo):
        assert_accessible(tab, name)
        expect(mark).to_be_in_viewport()
        seen.add(name.split("-")[0])
    assert seen >= {view.lower() for view in VIEWS}


def test_axe_finds_nothing_where_something_is_in_the_way(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=None)
    for name in walk_obstacles(tab, demo):
        assert_accessible(tab, name)


def test_axe_finds_nothing_where_a_holder_key_is_asked(open_tab: OpenTab, local: Served) -> None:
    tab = open_tab(local, sign_in=None)
    for name in walk_passkeys(tab, local):
        assert_accessible(tab, name)


def test_axe_finds_nothing_while_the_head_moves(open_tab: OpenTab, moving: Served) -> None:
    tab = open_tab(moving, sign_in=None)
    for name in walk_challenge(tab, moving):
        assert_accessible(tab, name)


def test_axe_finds_nothing_where_faces_are_real(
    open_tab: OpenTab, real: Served, camera: FakeCamera, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(real, sign_in=None)
    for name in walk_real(tab, real, camera, people[WHO], people[OTHER]):
        assert_accessible(tab, name)


def test_axe_finds_a_fault_that_is_planted(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.page.evaluate("document.querySelector('label[for]').removeAttribute('for')")
    assert any(name == "label" for name, _ in findings(tab.page))


def test_the_keyboard_alone_reaches_every_view(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=None)
    page = tab.page
    page.goto(tab.url)
    page.wait_for_selector("#key")
    press_until(page, "#key")
    page.keyboard.type(demo.token)
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1, name="Verify")).to_be_focused()
    for view in VIEWS[1:]:
        press_until(page, f"nav a[data-view={view.lower()}]")
        outline = page.evaluate("getComputedStyle(document.activeElement).outlineStyle")
        assert outline == "solid"
        page.keyboard.press("Enter")
        heading = page.get_by_role("heading", level=1)
        expect(heading).to_be_focused()
        expect(page).to_have_title(f"{view} · Veilface")
    press_until(page, ".skip")
    page.keyboard.press("Enter")
    expect(page.get_by_role("main")).to_be_focused()
    expect(page.get_by_role("heading", level=1, name="Service")).to_be_visible()
    press_until(page, "#who button")
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_focused()


def test_the_keyboard_alone_verifies_and_erases(open_tab: OpenTab, demo: Served) -> None:
    photo = (demo.settings.data_dir / "people" / "person-2" / "0.png").read_bytes()
    with demo.client() as client:
        files = {"images": ("0.png", photo)}
        assert client.put("/v1/subjects/by-key/enrollment", files=files).is_success
    tab = open_tab(demo)
    page = tab.page
    press_until(page, "input[type=text]")
    page.keyboard.type("by-key")
    press_until(page, "button.shot")
    page.keyboard.press("Enter")
    expect(page.locator(".tray .seen[data-state=good]")).to_be_visible()
    press_until(page, "button[type=submit]")
    page.keyboard.press("Enter")
    expect(page.locator(".verdict")).to_be_visible()
    tab.open("People")
    page.wait_for_selector("li.person")
    press_until(page, "button[aria-label='Erase by-key']")
    page.keyboard.press("Enter")
    expect(page.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    expect(page.locator(".verdict")).to_contain_text("Erased by-key")
    expect(page.locator(".verdict")).to_be_focused()


def press_until(page: Page, selector: str) -> None:
    """Press Tab until an element has the focus; a page has fewer than a hundred stops."""
    for _ in range(100):
        page.keyboard.press("Tab")
        if page.evaluate("s => document.activeElement.matches(s)", selector):
            return
    pytest.fail(f"Tab does not reach {selector}")
