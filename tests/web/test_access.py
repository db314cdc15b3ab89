"""Everybody can use it: axe, the keyboard alone, narrow screens, light and dark."""

import pytest
from playwright.sync_api import Page, expect

from tests.web.access import assert_accessible, serious
from tests.web.conftest import OpenTab
from tests.web.served import Served
from tests.web.test_demo import choose

pytestmark = pytest.mark.long

VIEWS = ("Verify", "Enroll", "People", "Stored", "Service")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1280])
def test_axe_finds_nothing_serious_on_any_view(
    open_tab: OpenTab, demo: Served, width: int, scheme: str
) -> None:
    tab = open_tab(demo, sign_in=None, width=width, color_scheme=scheme, reduced_motion="reduce")
    page, tag = tab.page, f"{width}-{scheme}"
    page.goto(tab.url)
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    assert_accessible(tab, f"sign-in-{tag}")
    page.get_by_label("API key").fill("vf_000000000000_" + "0" * 64)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("unauthorized")
    assert_accessible(tab, f"refused-{tag}")
    tab.sign_in(demo.token)
    for view in VIEWS:
        tab.open(view)
        match view:
            case "Verify":
                page.get_by_label("Person's id").fill("person-2")
                choose(tab, "person-101", 1)
                page.get_by_role("button", name="Verify", exact=True).click()
                expect(page.locator(".verdict.reject")).to_be_visible()
                assert_accessible(tab, f"reject-{tag}")
                choose(tab, "person-2", 4)
                page.get_by_role("button", name="Verify", exact=True).click()
                expect(page.locator(".verdict.accept")).to_be_visible()
            case "Enroll":
                choose(tab, "person-1", 1)
            case "People":
                expect(page.locator("li.person").first).to_be_visible()
                page.get_by_role("button", name="Erase person-2").click()
                expect(page.get_by_role("dialog")).to_be_visible()
                assert_accessible(tab, f"dialog-{tag}")
                page.keyboard.press("Escape")
            case "Stored":
                page.get_by_label("Person's id").fill("person-2")
                page.get_by_role("button", name="Show").click()
                expect(page.get_by_role("figure")).to_be_visible()
                expect(page.get_by_text("This deployment has not been audited.")).to_be_visible()
            case "Service":
                expect(page.get_by_text("✓ up")).to_have_count(2)
        assert_accessible(tab, f"{view.lower()}-{tag}")


def test_axe_finds_a_fault_that_is_planted(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.page.evaluate("document.querySelector('label[for]').removeAttribute('for')")
    assert any(name == "label" for name, _ in serious(tab.page))


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
    expect(page.get_by_role("heading", level=1, name=VIEWS[-1])).to_be_visible()
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
