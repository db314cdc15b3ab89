"""Every view of the page in its common states, one after the other, for axe and for pictures."""

import io
from collections.abc import Iterator
from pathlib import Path

from playwright.sync_api import expect

from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera, browsers_test_picture
from tests.web.served import Served

SUBJECT = "alice"
REFUSED_TOKEN = "vf_000000000000_" + "0" * 64


def choose(tab: BrowserTab, person: str, shot: int) -> None:
    """Take one photo of a drawn person."""
    tab.page.get_by_label("Cartoon person").select_option(person)
    tab.page.get_by_role("button", name=f"Choose photo {shot} of {person}", exact=True).click()
    expect(tab.page.locator(".tray .seen[data-state=good]").last).to_be_visible()


def walk_demo(tab: BrowserTab, demo: Served) -> Iterator[str]:
    """Visit every view of the demo's page in its common states; yield the name of each.

    `tab` is not signed in. Whom the walk enrolls is erased at its end, however that comes.
    """
    try:
        yield from _demo_states(tab, demo)
    finally:
        forget_subject(demo)


def _demo_states(tab: BrowserTab, demo: Served) -> Iterator[str]:
    page = tab.page
    button, alert, verdict = page.get_by_role, page.get_by_role("alert"), page.locator(".verdict")
    page.goto(tab.url)
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    yield "sign-in"
    page.get_by_label("API key").fill(REFUSED_TOKEN)
    button("button", name="Sign in").click()
    expect(alert).to_contain_text("unauthorized")
    yield "sign-in-refused"
    tab.sign_in(demo.key("verify"))
    tab.open("Enroll")
    yield "enroll-switched-off"
    button("button", name="Sign out").click()
    tab.sign_in(demo.token)
    yield "verify"

    tab.open("Enroll")
    yield "enroll"
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(tab, "person-1", 1)
    choose(tab, "person-1", 2)
    page.get_by_label("Files", exact=True).check()
    yield "enroll-files"
    page.locator("input[type=file]").first.set_input_files(
        {"name": "empty.png", "mimeType": "image/png", "buffer": without_a_face()}
    )
    expect(page.locator(".seen[data-state=bad]")).to_be_visible()
    button("button", name="Enroll", exact=True).click()
    expect(alert).to_contain_text("no_face")
    yield "enroll-photo-refused"
    button("button", name="Remove photo from empty.png").click()
    page.get_by_label("Lock to a key file").check()
    yield "enroll-key-file"
    page.get_by_label("None", exact=True).check()
    button("button", name="Enroll", exact=True).click()
    expect(verdict).to_contain_text("Enrolled")
    yield "enrolled"
    page.get_by_label("Cartoon people", exact=True).check()
    choose(tab, "person-1", 1)
    button("button", name="Enroll", exact=True).click()
    expect(page.get_by_role("dialog")).to_be_visible()
    yield "enroll-replace"
    page.keyboard.press("Escape")

    tab.open("Verify")
    page.get_by_label("Person's id").click()
    expect(page.locator("datalist option")).not_to_have_count(0)
    yield "verify-people"
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(tab, "person-101", 1)
    yield "verify-chosen"
    button("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.reject")).to_be_visible()
    yield "verify-rejected"
    choose(tab, "person-1", 5)
    button("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.accept")).to_be_visible()
    yield "verify-accepted"
    page.get_by_label("Camera", exact=True).check()
    yield "verify-camera-off"
    lock(demo)
    page.get_by_label("Cartoon people", exact=True).check()
    choose(tab, "person-101", 1)
    button("button", name="Verify", exact=True).click()
    expect(alert).to_contain_text("locked_out")
    yield "verify-locked-out"

    tab.open("People")
    expect(page.locator("li.person").first).to_be_visible()
    yield "people"
    button("button", name=f"Erase {SUBJECT}").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    yield "people-erase"
    page.keyboard.press("Escape")

    tab.open("Service")
    expect(page.get_by_text("✓ up")).to_have_count(2)
    yield "service"

    tab.open("People")
    button("button", name=f"Erase {SUBJECT}").click()
    page.get_by_role("dialog").get_by_role("button", name="Erase", exact=True).click()
    expect(verdict).to_contain_text(f"Erased {SUBJECT}")
    yield "people-erased"


def walk_real(
    tab: BrowserTab, real: Served, camera: FakeCamera, own: list[Path], other: list[Path]
) -> Iterator[str]:
    """Visit what only a real pack shows: boxes around faces, and guidance.

    `tab` is not signed in. Whom the walk enrolls is erased at its end, however that comes.
    """
    try:
        yield from _real_states(tab, real, camera, own, other)
    finally:
        forget_subject(real)


def _real_states(
    tab: BrowserTab, real: Served, camera: FakeCamera, own: list[Path], other: list[Path]
) -> Iterator[str]:
    page = tab.page
    tab.sign_in(real.token)
    verdict, good = page.locator(".verdict"), page.locator(".tray .seen[data-state=good]")
    tab.open("People")
    expect(page.get_by_text("Nobody is enrolled yet.")).to_be_visible()
    yield "real-people-none"
    tab.open("Enroll")
    page.get_by_label("Person's id").fill(SUBJECT)
    camera.shows(own[0])
    page.get_by_role("button", name="Start camera").click()
    tab.guided("Good: one face")
    yield "real-camera"
    page.get_by_role("button", name="Take 3 photos").click()
    expect(good).to_have_count(3)
    page.get_by_label("Files", exact=True).check()
    page.get_by_label("Photos: JPEG").set_input_files([own[1], other[0]])
    expect(good).to_have_count(5)
    page.get_by_role("button", name="Enroll", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("inconsistent_images")
    yield "real-enroll-refused"
    page.get_by_role("button", name=f"Remove photo from {other[0].name}").click()
    page.get_by_role("button", name="Enroll", exact=True).click()
    expect(verdict).to_contain_text("Enrolled")
    yield "real-enrolled"
    tab.open("Verify")
    page.get_by_label("Person's id").fill(SUBJECT)
    page.get_by_label("Files", exact=True).check()
    page.get_by_label("Photos: JPEG").set_input_files(own[2])
    expect(good).to_have_count(1)
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.accept")).to_be_visible()
    yield "real-accepted"
    tab.open("Service")
    expect(page.get_by_text("✓ up")).to_have_count(2)
    yield "real-service"


def forget_subject(served: Served) -> None:
    """Erase the walk's subject and its lockout; one who was never enrolled is not found."""
    with served.client() as client:
        assert client.delete(f"/v1/subjects/{SUBJECT}").status_code in (200, 404)


def without_a_face() -> bytes:
    """Draw a sharp picture without a face."""
    out = io.BytesIO()
    browsers_test_picture((240, 240)).save(out, "PNG")
    return out.getvalue()


def lock(demo: Served) -> None:
    """Let a stranger fail at the walk's subject until it is locked."""
    with demo.client() as client:
        stranger = client.get("/demo/people/person-101/0.png").content
        for _ in range(6):
            client.post(f"/v1/subjects/{SUBJECT}/verify", files={"image": ("0.png", stranger)})
