"""The key and what it may do; and that the record of a tab sees what it is there to see."""

import pytest
from playwright.sync_api import Route, expect

from tests.patience import wait_until
from tests.web.answers import PendingRequests, refused
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
    tab.press("Sign out")
    expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_focused()
    assert page.evaluate("sessionStorage.length + localStorage.length") == 0
    assert demo.token not in page.content()
    assert not any(demo.token in url for url in tab.requests)
    assert demo.token not in demo.log.read_text()


def test_a_key_is_kept_while_the_service_does_not_answer(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=None)
    page = tab.page
    tab.sign_in(demo.token, keep=True)
    tab.open("People")
    page.route("**/v1/key", lambda route: route.fulfill(**refused(429, "rate_limited", "later")))
    page.reload()
    tab.is_refused("rate_limited")
    page.unroute("**/v1/key")
    page.reload()
    expect(page.get_by_role("heading", level=1, name="People")).to_be_visible()


def test_signing_out_ends_an_attempt_and_leaves_no_name_in_the_address(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo)
    page = tab.page
    page.evaluate("location.hash = '#/verify/anna'")
    expect(page.get_by_label("Person’s id")).to_have_value("anna")
    tab.choose_drawn("person-2", 1)
    pending = PendingRequests(page, "**/verify")
    button = page.locator("form button[type=submit]").element_handle()
    tab.press("Verify")
    pending.wait()
    tab.press("Sign out")
    expect(page.get_by_label("API key")).to_be_visible()
    assert page.url == tab.url
    wait_until(lambda: button.text_content() == "Verify", what="the attempt has ended")
    tab.complaints[:] = [each for each in tab.complaints if "ERR_ABORTED" not in each]


def test_what_a_key_may_not_do_is_switched_off_with_the_reason(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo, sign_in=demo.key("verify"))
    page = tab.page
    tab.name_person("found-")
    tab.choose_drawn("person-2", 1)
    assert not [url for url in tab.requests if "/v1/subjects" in url]
    tab.open("Enroll")
    expect(page.get_by_label("Person’s id")).to_be_disabled()
    expect(page.get_by_role("button", name="Enroll", exact=True)).to_be_disabled()
    tab.open("People")
    for right in ("enroll", "erase"):
        note = page.get_by_role("note").filter(has_text=f"does not have the right “{right}”")
        expect(note).to_be_visible()
    tab.open("Service")
    rights = page.locator(".facts div").filter(has_text="Rights")
    expect(rights).to_have_text("Rightsverify")


def test_below_a_prefix_the_page_works_alike(open_tab: OpenTab, demo: Served) -> None:
    """As a proxy serves it: the page asks for nothing outside the prefix."""
    tab = open_tab(demo, sign_in=None)

    def passed_on(route: Route) -> None:
        route.fulfill(response=route.fetch(url=route.request.url.replace("/face", "", 1)))

    tab.page.route("**/face/**", passed_on)
    tab.url += "face/"
    tab.sign_in(demo.token)
    tab.choose_drawn("person-2", 1)
    tab.open("Service")
    expect(tab.page.get_by_text("Database and model are up")).to_be_visible()
    assert {url for url in tab.requests if not url.startswith(("blob:", tab.url))} == set()


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
