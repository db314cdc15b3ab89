"""The key and what it may do; and that the record of a tab sees what it is there to see."""

import pytest
from playwright.sync_api import Route, expect

from tests.web.answers import refused
from tests.web.conftest import OpenTab
from tests.web.served import Served

pytestmark = pytest.mark.long


def test_a_reload_keeps_the_session_unless_that_is_not_wanted(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo)
    page = tab.page
    assert page.evaluate("sessionStorage.length + localStorage.length") == 0
    assert page.evaluate("document.cookie") == ""
    page.reload()
    expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_visible()
    expect(page.get_by_label("Keep me signed in until I close this tab")).to_be_checked()
    tab.sign_in(demo.token, keep=True)
    tab.open("People")
    page.reload()
    expect(page.get_by_role("heading", level=1, name="People")).to_be_visible()
    assert page.evaluate("localStorage.length") == 0
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_focused()
    assert page.evaluate("sessionStorage.length + localStorage.length") == 0
    assert demo.token not in page.content()
    assert not any(demo.token in url for url in tab.requests)
    assert demo.token not in demo.log.read_text()


def test_what_a_key_may_not_do_is_switched_off_with_the_reason(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo, sign_in=demo.key("verify"))
    page = tab.page
    expect(page.get_by_label("Person's id")).to_be_enabled()
    for view in ("Enroll", "People"):
        tab.open(view)
        expect(
            page.get_by_role("note").filter(has_text="does not have the right “enroll”")
        ).to_be_visible()
    tab.open("Enroll")
    expect(page.get_by_label("Person's id")).to_be_disabled()
    expect(page.get_by_role("button", name="Enroll", exact=True)).to_be_disabled()
    erase = page.get_by_role("note").filter(has_text="does not have the right “erase”")
    tab.open("People")
    expect(erase).to_be_visible()
    tab.open("Service")
    expect(page.get_by_role("list", name="Rights")).to_contain_text("verify: may verify people")
    expect(page.get_by_role("list", name="Rights")).to_contain_text("erase: may not erase")


def test_a_key_that_is_revoked_meanwhile_signs_out(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    answer = refused(401, "unauthorized", "send a valid API key")
    tab.page.route("**/v1/subjects?*", lambda route: route.fulfill(**answer))
    tab.page.get_by_role("link", name="People").click()
    expect(tab.page.get_by_role("heading", level=1, name="Sign in")).to_be_visible()
    expect(tab.page.get_by_role("alert")).to_contain_text("unauthorized")


def test_a_service_that_is_away_is_said(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.page.route("**/v1/subjects?*", lambda route: route.abort())
    tab.open("People")
    alert = tab.page.get_by_role("alert")
    expect(alert).to_contain_text("The service does not respond.")
    expect(alert).to_contain_text("unreachable")
    assert tab.complaints == ["Failed to load resource: net::ERR_FAILED"]
    tab.complaints.clear()


def test_guidance_waits_as_long_as_it_is_told(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    asked: list[str] = []

    def too_many(route: Route) -> None:
        asked.append("check")
        route.fulfill(**refused(429, "rate_limited", "too many requests", wait=30))

    tab.page.route("**/v1/photos/check", too_many)
    tab.page.get_by_label("Camera", exact=True).check()
    tab.page.get_by_role("button", name="Start camera").click()
    tab.guided("Guidance is paused: too many requests.")
    tab.page.wait_for_timeout(2500)
    assert asked == ["check"]
    expect(tab.page.get_by_role("button", name="Take 3 photos")).to_be_enabled()


def test_a_request_elsewhere_would_be_seen(open_tab: OpenTab, demo: Served) -> None:
    """The control of what every other test relies on."""
    tab = open_tab(demo)
    tab.page.evaluate("fetch('http://elsewhere.invalid/').catch(() => {})")
    tab.page.evaluate("document.body.append(Object.assign(document.createElement('style'), "
                      "{textContent: 'body {color: red}'}))")  # fmt: skip
    tab.wait_for("() => window.violations.length >= 2")
    assert {each.split(" ")[0] for each in tab.violations()} == {"connect-src", "style-src-elem"}
    assert tab.complaints
    with pytest.raises(AssertionError):
        tab.assert_clean()
    tab.page.evaluate("window.violations = []")
    tab.complaints.clear()
    tab.requests.append("http://elsewhere.invalid/")
    assert tab.strays() == ["http://elsewhere.invalid/"]
    with pytest.raises(AssertionError):
        tab.assert_clean()
    tab.requests[:] = [url for url in tab.requests if "elsewhere" not in url]
