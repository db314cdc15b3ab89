"""The page where something is in the way: no camera, no passkey, nobody, too many requests."""

from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import expect

from tests.web.answers import PendingRequests, refused
from tests.web.browser_tab import BrowserTab
from tests.web.deployments import ANNA
from tests.web.moving_head import camera_script
from tests.web.passkeys import Authenticator
from tests.web.served import Served
from tests.web.walk import SUBJECT, choose, forget_subject

PERSON = "person-1"
NOBODY = "nobody-here"
DENY = """
navigator.mediaDevices.getUserMedia = async () => {
  throw new DOMException("no", "NotAllowedError");
};
null;
"""
LOSE = """
[...document.querySelectorAll("video")].find((each) => each.srcObject)
  .srcObject.getVideoTracks()[0].dispatchEvent(new Event("ended"));
"""
# Who sits still gives the same frames at any speed.
HASTEN = """
const slowly = window.setTimeout.bind(window);
window.setTimeout = (call, ms, ...rest) => slowly(call, window.sitsStill ? ms / 10 : ms, ...rest);
"""
TO_PASSKEY, TO_FILE = "Lock to a passkey", "Lock to a key file"
START = "Start head movements"


@contextmanager
def answered(tab: BrowserTab, pattern: str, status: int, code: str, message: str) -> Iterator[None]:
    """Refuse requests in the place of the service; half a minute's wait, where it asks for one."""
    wait = 30 if status == 429 else None
    answer = refused(status, code, message, wait=wait)
    tab.page.route(pattern, lambda route: route.fulfill(**answer))
    yield
    tab.page.unroute(pattern)


def walk_obstacles(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """Visit what the demo's page shows when it cannot go on; yield the name of each state.

    `tab` is not signed in.
    """
    page = tab.page
    alert, button = page.get_by_role("alert"), page.get_by_role
    tab.sign_in(demo.token)
    page.get_by_label("Person's id").fill(NOBODY)
    expect(page.get_by_text("Nobody is enrolled under this id.")).to_be_visible()
    choose(tab, PERSON, 1)
    button("button", name="Verify", exact=True).click()
    expect(alert).to_contain_text("not_enrolled")
    yield "verify-not-enrolled"
    with answered(tab, "**/verify", 429, "rate_limited", "too many requests"):
        button("button", name="Verify", exact=True).click()
        expect(alert).to_contain_text("rate_limited")
        yield "verify-rate-limited"

    page.get_by_label("Camera", exact=True).check()
    with answered(tab, "**/v1/photos/check", 429, "rate_limited", "too many requests"):
        button("button", name="Start camera").click()
        tab.guided("Guidance is paused")
        yield "camera-rate-limited"
    page.evaluate(LOSE)
    tab.guided("The camera has stopped.")
    yield "camera-lost"
    page.evaluate(DENY)
    button("button", name="Start camera").click()
    tab.guided("Camera access was denied.")
    yield "camera-refused"

    tab.open("People")
    page.get_by_label("Find people whose id begins with").fill(NOBODY)
    expect(page.get_by_text("Nobody’s id begins so.")).to_be_visible()
    yield "people-not-found"
    tab.open("Service")
    with answered(tab, "**/v1/subjects?*", 401, "unauthorized", "send a valid API key"):
        button("link", name="People").click()
        expect(button("heading", level=1, name="Sign in")).to_be_visible()
        expect(alert).to_contain_text("unauthorized")
    yield "session-expired"


def walk_passkeys(tab: BrowserTab, local: Served) -> Iterator[str]:
    """Visit what the page shows of a holder key; yield the name of each state.

    `tab` is not signed in, and is at a name: an IP address has no passkeys. Whom the walk enrolls
    is erased at its end, however that comes.
    """
    try:
        yield from _passkey_states(tab, local)
    finally:
        forget_subject(local)


def _passkey_states(tab: BrowserTab, local: Served) -> Iterator[str]:
    page = tab.page
    alert, verdict = page.get_by_role("alert"), page.locator(".verdict")
    authenticator = Authenticator.of(page)
    tab.sign_in(local.token)
    enroll = page.get_by_role("button", name="Enroll", exact=True)

    def ask() -> None:
        tab.open("Enroll")
        page.get_by_label("Person's id").fill(SUBJECT)
        choose(tab, PERSON, 1)
        page.get_by_label(TO_PASSKEY).check()
        enroll.click()

    authenticator.exchange(answers=False)
    ask()
    expect(page.get_by_role("button", name="Waiting for the passkey…")).to_be_visible()
    yield "passkey-asked"
    tab.open("People")  # leaving takes the question back
    authenticator.exchange(prf=False)
    ask()
    expect(alert).to_contain_text("passkey_unsupported")
    yield "passkey-unsupported"
    authenticator.exchange()
    authenticator.refuse()
    enroll.click()
    expect(alert).to_contain_text("passkey_refused")
    yield "passkey-refused"
    page.get_by_label(TO_FILE).check()
    yield "passkey-file"
    page.get_by_label(TO_PASSKEY).check()
    authenticator.exchange()
    enroll.click()
    expect(verdict).to_contain_text("needed at every verification")
    yield "passkey-enrolled"

    tab.open("Verify")
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(tab, PERSON, 4)
    verify = page.get_by_role("button", name="Verify", exact=True)
    verify.click()
    expect(page.locator(".verdict.accept")).to_be_visible()
    yield "passkey-accepted"
    authenticator.exchange()
    verify.click()
    expect(alert).to_contain_text("passkey_refused")
    yield "passkey-none"
    page.get_by_role("radio", name="Key file").check()
    yield "passkey-verify-file"
    page.get_by_label("None", exact=True).check()
    verify.click()
    expect(page.locator(".verdict.reject")).to_be_visible()
    yield "passkey-not-shown"
    tab.open("People")
    expect(page.locator("li.person").filter(has_text=SUBJECT)).to_be_visible()
    yield "passkey-people"


def walk_challenge(tab: BrowserTab, moving: Served) -> Iterator[str]:
    """Visit head movements, from before the first to the answer; yield the name of each state.

    `tab` is not signed in.
    """
    page = tab.page
    alert, start = page.get_by_role("alert"), page.get_by_role("button", name=START)
    shown = '(asked) => window.sitsStill ? "front" : asked'
    page.add_init_script(camera_script(shown, person=ANNA))
    page.add_init_script(HASTEN)
    tab.sign_in(moving.token)
    page.get_by_label("Person's id").fill("anna")
    expect(start).to_be_enabled()
    yield "challenge"
    challenges = PendingRequests(page, "**/v1/challenges")
    start.click()
    challenges.wait()
    yield "challenge-ready"
    page.evaluate(LOSE)
    expect(alert).to_contain_text("The camera has stopped.")
    yield "challenge-camera-lost"
    page.unroute("**/v1/challenges")
    start.click()
    expect(page.locator(".movement:not([data-movement=front])")).to_be_visible()
    # By the clock: what is looked at last may be the next one.
    yield "challenge-movement"
    expect(page.locator(".verdict.accept")).to_contain_text("passed")
    yield "challenge-passed"
    page.evaluate("window.sitsStill = true")
    start.click()
    expect(page.locator(".verdict.reject")).to_contain_text("the head did not turn")
    yield "challenge-failed"
    page.evaluate(DENY)
    start.click()
    expect(alert).to_contain_text("Camera access was denied.")
    yield "challenge-camera-refused"
