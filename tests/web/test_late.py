"""What comes late: answers after the visitor went on, and a key that was changed meanwhile."""

import contextlib

import pytest
from playwright.sync_api import Error, Page, expect

from tests.web.answers import PendingRequests, refused
from tests.web.conftest import OpenTab
from tests.web.served import Served
from tests.web.walk import choose

pytestmark = pytest.mark.long

DECISION = {
    "decision": "accept", "reason": "match", "level": "fmr-1e-2", "fmr": 0, "contract_id": "0" * 64,
    "calibration_id": "0" * 64, "request_id": "0" * 32,
}  # fmt: skip
BLOCKED = """
Object.defineProperty(window, "sessionStorage", {
  get() { throw new DOMException("blocked", "SecurityError"); },
});
"""


def test_a_late_decision_names_whom_it_is_about(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    subject = page.get_by_label("Person's id")
    pending = PendingRequests(page, "**/verify")
    for heard in (False, True):
        pending.routes.clear()
        subject.fill("alice")
        choose(tab, "person-2", 1)
        page.get_by_role("button", name="Verify", exact=True).click()
        waiting = pending.wait()
        expect(subject).to_be_disabled()
        expect(page.get_by_role("button", name="Remove photo")).to_be_disabled()
        subject.evaluate(
            "(input, heard) => { input.value = 'bob'; input.form.requestSubmit();"
            " if (heard) input.dispatchEvent(new Event('input')); }",
            heard,
        )
        waiting.fulfill(json=DECISION)
        expect(subject).to_be_enabled()
        if heard:
            # Something else is asked by now: the answer is not shown at all.
            expect(page.locator(".verdict")).to_have_count(0)
        else:
            expect(page.locator(".verdict")).to_contain_text("Personalice")
            expect(page.locator(".verdict")).to_contain_text("0 % (none seen)")
        assert len(pending.routes) == 1


def test_a_late_enrollment_is_of_the_photos_that_were_sent(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Enroll")
    subject = page.get_by_label("Person's id")
    subject.fill("alice")
    for shot in (1, 2):
        choose(tab, "person-1", shot)
    photo, enrollment = (
        PendingRequests(page, "**/demo/people/person-1/2.png"),
        PendingRequests(page, "**/enrollment"),
    )
    page.get_by_role("button", name="Choose photo 3 of person-1").click()
    late = photo.wait()
    page.get_by_role("button", name="Enroll", exact=True).click()
    waiting = enrollment.wait()
    expect(subject).to_be_disabled()
    late.continue_()
    expect(page.locator(".tray li")).to_have_count(3)
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(3)
    subject.evaluate("(input) => { input.value = 'bob'; input.form.requestSubmit(); }")
    # The first photo was sent, the third one was not.
    waiting.fulfill(**refused(422, "inconsistent_images", "they differ", photos=[0, 2]))
    expect(page.locator(".tray .seen[data-state=bad]")).to_have_count(1)
    assert len(enrollment.routes) == 1

    enrollment.routes.clear()
    page.get_by_label("Remove photo from person-1, photo 3").click()
    page.get_by_role("button", name="Choose photo 3 of person-1").click()
    subject.fill("alice")
    page.get_by_role("button", name="Enroll", exact=True).click()
    waiting = enrollment.wait()
    photo.routes[1].continue_()
    expect(page.locator(".tray li")).to_have_count(3)
    subject.evaluate("(input) => { input.value = 'bob'; }")
    images = [{"index": index, "status": "used", "quality": {}} for index in range(2)]
    waiting.fulfill(
        status=201,
        json={"template_id": "0" * 32, "contract_id": "0" * 64, "replaced": False,
              "images": images, "request_id": "0" * 32},
    )  # fmt: skip
    expect(page.locator(".verdict")).to_contain_text("Personalice")
    # It came too late to be sent, and is there still.
    expect(page.locator(".tray li")).to_have_count(1)
    expect(page.locator(".tray")).to_contain_text("Good")
    expect(page.get_by_label("Remove photo from person-1, photo 3")).to_be_visible()


def test_a_late_refusal_of_another_key_does_not_sign_out(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    pending = PendingRequests(page, "**/v1/subjects?*")
    page.get_by_role("link", name="People").click()
    waiting = pending.wait()
    page.get_by_role("button", name="Sign out").click()
    page.get_by_label("API key").fill(demo.token)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("button", name="Sign out")).to_be_visible()
    # It was ended with the key it was made with, so it may be too late to answer it.
    with contextlib.suppress(Error):
        waiting.fulfill(**refused(401, "unauthorized", "send a valid API key"))
    page.wait_for_timeout(200)
    expect(page.get_by_role("button", name="Sign out")).to_be_visible()
    tab.complaints[:] = [each for each in tab.complaints if "ERR_ABORTED" not in each]


def people(page: Page, *names: str) -> PendingRequests:
    """Show these people, whose erasures wait for the test."""
    described = [
        {"subject_id": name, "template_id": "0" * 32, "contract_id": "0" * 64, "current": True,
         "enrolled_by": "photos", "photos": 1, "created_at": "2026-01-31T12:00:00Z",
         "updated_at": "2026-01-31T12:00:00Z"}
        for name in names
    ]  # fmt: skip
    page.route(
        "**/v1/subjects?*",
        lambda route: route.fulfill(
            json={"subjects": described, "next_cursor": None, "request_id": "0" * 32}
        ),
    )
    return PendingRequests(page, "**/v1/subjects/*")


def erase(page: Page, name: str) -> None:
    page.get_by_role("button", name=f"Erase {name}", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Erase", exact=True).click()


def test_every_receipt_stays_and_no_failure_is_lost(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    pending = people(page, "ada", "bob", "cleo")
    tab.open("People")
    for name in ("ada", "bob"):
        pending.routes.clear()
        erase(page, name)
        claims = {"erased_at": "2026-01-31T12:00:00Z", "erased": [], "subject": "0" * 64,
                  "signing_key": "0f3a", "receipt_id": name}  # fmt: skip
        pending.wait().fulfill(json={"receipt": {}, "claims": claims, "request_id": "0" * 32})
        expect(page.locator(".verdict").first).to_contain_text(f"Erased {name}")
    expect(page.get_by_role("button", name="Download receipt")).to_have_count(2)

    pending.routes.clear()
    erase(page, "cleo")
    pending.wait().fulfill(**refused(429, "rate_limited", "too many requests"))
    expect(page.get_by_role("alert")).to_contain_text("rate_limited")
    expect(page.get_by_role("alert")).to_be_visible()


def test_a_browser_without_storage_and_a_view_that_is_none(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=None)
    tab.page.add_init_script(BLOCKED)
    tab.sign_in(demo.token, keep=True)
    for name in ("constructor", "toString", "__proto__", ""):
        tab.page.evaluate("name => { location.hash = `#/${name}`; }", name)
        expect(tab.page.get_by_role("heading", level=1, name="Verify")).to_be_visible()
    tab.page.get_by_role("button", name="Sign out").click()
    expect(tab.page.get_by_role("heading", level=1, name="Sign in")).to_be_visible()
