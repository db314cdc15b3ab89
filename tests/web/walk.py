"""Every view of the page in its states: each is looked at by axe, and pictured."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import expect

from tests.web.answers import PendingRequests, refused
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera, browsers_test_picture
from tests.web.deployments import ANNA
from tests.web.moving_head import camera_script
from tests.web.passkeys import Authenticator
from tests.web.served import Served

SUBJECT, PERSON, STRANGER = "alice", "person-1", "person-101"
NOBODY = "nobody-here"
START = "Start head movements"
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


@contextmanager
def answered(tab: BrowserTab, pattern: str, status: int, code: str, message: str) -> Iterator[None]:
    """Refuse requests in the place of the service; half a minute's wait, where it asks for one."""
    answer = refused(status, code, message, wait=30 if status == 429 else None)
    tab.page.route(pattern, lambda route: route.fulfill(**answer))
    yield
    tab.page.unroute(pattern)


@contextmanager
def forgotten(served: Served) -> Iterator[None]:
    """Erase the walk's subject and its lockout at the end, however that comes."""
    try:
        yield
    finally:
        with served.client() as client:
            assert client.delete(f"/v1/subjects/{SUBJECT}").status_code in (200, 404)


def walk_sign_in(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """Sign in: refused, with too few rights, and signed out by the service."""
    page = tab.page
    page.goto(tab.url)
    expect(page.get_by_text("cat demo-data/api-key")).to_be_visible()
    yield "sign-in"
    page.get_by_label("API key").fill(f"vf_{'0' * 12}_{'0' * 64}")
    tab.press("Sign in")
    tab.is_refused("unauthorized")
    yield "sign-in-refused"
    tab.sign_in(demo.key("verify"))
    for view in ("Enroll", "People"):
        tab.open(view)
        lacks = page.get_by_role("note").filter(has_text="not have the right “enroll”")
        expect(lacks).to_be_visible()
        yield f"{view.lower()}-switched-off"
    tab.press("Sign out")
    tab.sign_in(demo.token)
    with answered(tab, "**/v1/subjects?*", 401, "unauthorized", "send a valid API key"):
        page.get_by_role("link", name="People").click()
        expect(page.get_by_role("heading", level=1, name="Sign in")).to_be_visible()
        tab.is_refused("You were signed out", "unauthorized")
    yield "signed-out"


def walk_enroll(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """Enroll a new person, with photos that will not do among others, and fewer in their place."""
    page, progress = tab.page, tab.page.locator(".progress")
    tab.sign_in(demo.token)
    tab.open("Enroll")
    expect(progress).to_contain_text("Three photos make a reliable login.")
    yield "enroll"
    with forgotten(demo):
        tab.name_person(SUBJECT)
        expect(page.get_by_text("New person.")).to_be_visible()
        tab.choose_drawn(PERSON, 1)
        expect(progress).to_contain_text("2 more for a reliable login.")
        yield "enroll-progress"
        for shot in (2, 3):
            tab.choose_drawn(PERSON, shot)
        expect(progress).to_contain_text("Enough for a reliable login.")
        empty = {"name": "empty.png", "mimeType": "image/png", "buffer": without_a_face()}
        tab.choose_files(empty)  # type: ignore[arg-type]
        expect(page.locator(".seen[data-state=bad]")).to_be_visible()
        tab.press("Enroll")
        tab.is_refused("Photo 4 of 4: no cartoon face was found", "no_face")
        yield "enroll-photo-refused"
        tab.press("Remove photo from empty.png")
        tab.press("Enroll")
        expect(page.locator(".verdict")).to_contain_text("Enrolled")
        yield "enrolled"
        tab.choose_drawn(PERSON, 1)
        tab.press("Enroll")
        expect(page.get_by_role("dialog")).to_contain_text("less reliable")
        yield "enroll-replace"


def walk_verify(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """Verify: nobody, a stranger, the person, too often; and a camera that cannot be used."""
    page = tab.page
    tab.sign_in(demo.token)
    yield "verify"
    tab.name_person(NOBODY)
    expect(page.get_by_text("Nobody is enrolled under this id.")).to_be_visible()
    tab.choose_drawn(PERSON, 1)
    tab.press("Verify")
    tab.is_refused("not_enrolled")
    yield "verify-not-enrolled"
    with answered(tab, "**/verify", 429, "rate_limited", "too many requests"):
        tab.press("Verify")
        tab.is_refused("rate_limited", "Try again in")
        yield "verify-rate-limited"
    with forgotten(demo):
        enroll(demo, SUBJECT, PERSON, shots=3)
        tab.name_person(SUBJECT)
        expect(page.get_by_text("✓ Enrolled: 3 photos")).to_be_visible()
        tab.choose_drawn(STRANGER, 1)
        tab.press("Verify")
        tab.is_decided("reject")
        yield "verify-rejected"
        tab.choose_drawn(PERSON, 5)
        tab.press("Verify")
        tab.is_decided("accept")
        expect(page.locator(".verdict")).to_contain_text("accepted up to")
        yield "verify-accepted"
        lock(demo)
        tab.press("Verify")
        tab.is_refused("locked_out")
        yield "verify-locked-out"
    page.get_by_label("Camera", exact=True).check()
    yield "camera-off"
    with answered(tab, "**/v1/photos/check", 429, "rate_limited", "too many requests"):
        tab.press("Start camera")
        tab.guided("Guidance is paused")
        yield "camera-rate-limited"
    page.evaluate(LOSE)
    tab.guided("The camera has stopped.")
    yield "camera-lost"
    page.evaluate(DENY)
    tab.press("Start camera")
    tab.guided("Camera access was denied.")
    yield "camera-refused"


def walk_people(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """List, find and erase people."""
    page, people = tab.page, tab.page.locator("li.person")
    tab.sign_in(demo.token)
    with forgotten(demo):
        enroll(demo, SUBJECT, PERSON)
        tab.open("People")
        expect(people.last).to_contain_text("person-2")
        expect(people.first).to_contain_text(f"{SUBJECT}1 photo, ")
        yield "people"
        search = page.get_by_label("Find by how the id begins")
        search.fill(NOBODY)
        expect(page.get_by_text("Nobody’s id begins so.")).to_be_visible()
        yield "people-not-found"
        search.fill(SUBJECT[:3])
        expect(people).to_have_count(1)
        tab.press(f"Erase {SUBJECT}")
        dialog = page.get_by_role("dialog")
        expect(dialog.get_by_role("button", name="Keep")).to_be_focused()
        yield "people-erase"
        dialog.get_by_role("button", name="Erase", exact=True).click()
        expect(page.locator(".verdict")).to_contain_text(f"Erased {SUBJECT}")
        yield "people-erased"


def walk_service(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """The verdict, what is stored, and what the key may do."""
    page = tab.page
    tab.sign_in(demo.token)
    tab.open("Service")
    expect(page.get_by_text("Database and model are up")).to_be_visible()
    expect(page.locator(".privacy")).to_contain_text("Privacy: not proven")
    yield "service"


def walk_real(
    tab: BrowserTab, real: Served, camera: FakeCamera, own: list[Path], other: list[Path]
) -> Iterator[str]:
    """What only a real pack shows: guidance, boxes around faces, a burst that is sent."""
    page = tab.page
    tab.sign_in(real.token)
    tab.open("People")
    expect(page.get_by_text("Nobody is enrolled yet")).to_be_visible()
    yield "real-people-none"
    with forgotten(real):
        tab.open("Enroll")
        tab.name_person(SUBJECT)
        camera.shows(own[0])
        tab.start_camera()
        tab.guided("Good: one face")
        yield "real-camera"
        tab.press("Take 3 photos")
        tab.good(3)
        tab.choose_files(own[1], other[0])
        tab.good(5)
        tab.press("Enroll")
        tab.is_refused("inconsistent_images")
        yield "real-enroll-refused"
        tab.press(f"Remove photo from {other[0].name}")
        tab.press("Enroll")
        expect(page.locator(".verdict")).to_contain_text("Photos used4")
        expect(page.locator(".verdict")).to_be_focused()
        yield "real-enrolled"
        for shown, decision in ((other, "reject"), (own, "accept")):
            tab.open("People")
            page.get_by_role("link", name=f"Verify {SUBJECT}").click()
            camera.shows(shown[2])
            tab.start_camera()
            tab.guided("Good: one face")
            tab.press("Verify")
            tab.is_decided(decision)
            expect(page.locator(".verdict")).to_contain_text("1 % (1 in 100)")
            tab.good(3)
            yield f"real-{decision}"
        tab.open("Service")
        expect(page.get_by_text("Database and model are up")).to_be_visible()
        yield "real-service"


def walk_private(
    tab: BrowserTab, served: Served, camera: FakeCamera, own: list[Path]
) -> Iterator[str]:
    """Private mode: what it says, an enrollment, and switched off."""
    page = tab.page
    tab.sign_in(served.token)
    expect(page.get_by_role("switch", name="Private mode")).to_be_checked()
    expect(page.get_by_text("photos stay in this browser")).to_be_visible()
    yield "private"
    with forgotten(served):
        tab.open("Enroll")
        tab.name_person(SUBJECT)
        camera.shows(own[0])
        tab.press("Start camera")
        expect(page.locator("veilface-login output")).to_have_text("Good. Hold still.")
        yield "private-camera"
        tab.press("Enroll")
        expect(page.locator(".verdict")).to_contain_text("Enrolled")
        yield "private-enrolled"
    page.get_by_role("switch", name="Private mode").uncheck()
    expect(page.get_by_text("Photos go to this service alone")).to_be_visible()
    yield "private-off"


def walk_passkeys(tab: BrowserTab, local: Served) -> Iterator[str]:
    """A holder key; `tab` is at a name, for an IP address has no passkeys."""
    page = tab.page
    authenticator = Authenticator.of(page)
    tab.sign_in(local.token)
    with forgotten(local):

        def ask() -> None:
            tab.open("Enroll")
            tab.name_person(SUBJECT)
            for shot in (1, 2, 3):
                tab.choose_drawn(PERSON, shot)
            tab.lock()
            tab.press("Enroll")

        authenticator.exchange(answers=False)
        ask()
        expect(page.get_by_role("button", name="Waiting for the passkey…")).to_be_visible()
        yield "passkey-asked"
        tab.open("People")  # leaving takes the question back
        authenticator.exchange(prf=False)
        ask()
        tab.is_refused("passkey_unsupported")
        yield "passkey-unsupported"
        authenticator.exchange()
        authenticator.refuse()
        tab.press("Enroll")
        tab.is_refused("passkey_refused")
        authenticator.exchange()
        tab.press("Enroll")
        expect(page.locator(".verdict")).to_contain_text("needed at every verification")
        assert authenticator.passkeys() == 1
        yield "passkey-enrolled"
        tab.open("Verify")
        tab.name_person(SUBJECT)
        tab.choose_drawn(PERSON, 5)
        tab.press("Verify")
        tab.is_decided("accept")
        yield "passkey-accepted"
        tab.lock(False)
        tab.press("Verify")
        tab.is_decided("reject")
        yield "passkey-not-shown"


def walk_challenge(tab: BrowserTab, moving: Served) -> Iterator[str]:
    """Head movements, from before the first to the answer."""
    page = tab.page
    shown = '(asked) => window.sitsStill ? "front" : asked'
    page.add_init_script(camera_script(shown, person=ANNA))
    page.add_init_script(HASTEN)
    tab.sign_in(moving.token)
    tab.name_person("anna")
    expect(page.get_by_role("button", name=START)).to_be_enabled()
    yield "challenge"
    challenges = PendingRequests(page, "**/v1/challenges")
    tab.press(START)
    challenges.wait()
    yield "challenge-ready"
    page.evaluate(LOSE)
    tab.is_refused("The camera has stopped.")
    yield "challenge-camera-lost"
    page.unroute("**/v1/challenges")
    tab.press(START)
    expect(page.locator(".movement:not([data-movement=front])")).to_be_visible()
    # By the clock: what is looked at last may be the next one.
    yield "challenge-movement"
    expect(page.locator(".verdict.accept")).to_contain_text("passed")
    yield "challenge-passed"
    page.evaluate("window.sitsStill = true")
    tab.press(START)
    expect(page.locator(".verdict.reject")).to_contain_text("failed (no turn)")
    yield "challenge-failed"


DEMO_WALKS = (walk_sign_in, walk_enroll, walk_verify, walk_people, walk_service)


def enroll(demo: Served, subject: str, person: str, shots: int = 1) -> None:
    """Enroll a drawn person, as often as it takes to replace nobody."""
    folder = demo.settings.data_dir / "people" / person
    photos = [("images", (f"{n}.png", (folder / f"{n}.png").read_bytes())) for n in range(shots)]
    with demo.client() as client:
        assert client.put(f"/v1/subjects/{subject}/enrollment", files=photos).is_success


def without_a_face() -> bytes:
    """Draw a sharp picture without a face."""
    out = io.BytesIO()
    browsers_test_picture((240, 240)).save(out, "PNG")
    return out.getvalue()


def lock(demo: Served, subject: str = SUBJECT) -> None:
    """Let a stranger fail at a subject until it is locked."""
    with demo.client() as client:
        stranger = client.get(f"/demo/people/{STRANGER}/0.png").content
        for _ in range(6):
            client.post(f"/v1/subjects/{subject}/verify", files={"image": ("0.png", stranger)})
