"""The camera ends when it should, guides, and takes bursts; files are made smaller."""

import io

import pytest
from PIL import Image
from playwright.sync_api import FilePayload, expect

from tests.web.answers import refused
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.served import Served

pytestmark = pytest.mark.long

WATCH = """
window.tracks = [];
window.bitmaps = {open: 0, most: 0, all: 0};
const media = navigator.mediaDevices;
const getUserMedia = media.getUserMedia.bind(media);
media.getUserMedia = async (wanted) => {
  const stream = await getUserMedia(wanted);
  window.tracks.push(...stream.getTracks());
  return stream;
};
const play = HTMLMediaElement.prototype.play;
HTMLMediaElement.prototype.play = async function () {
  await play.call(this);
  await window.playing;
};
const decode = window.createImageBitmap;
window.createImageBitmap = async (...given) => {
  const count = window.bitmaps;
  count.all += 1;
  count.most = Math.max(count.most, (count.open += 1));
  const bitmap = await decode(...given);
  const close = bitmap.close.bind(bitmap);
  bitmap.close = () => { count.open -= 1; close(); };
  return bitmap;
};
"""


def watched(open_tab: OpenTab, served: Served, **options: int) -> BrowserTab:
    tab = open_tab(served, sign_in=None, **options)
    tab.page.add_init_script(WATCH)
    tab.sign_in(served.token)
    return tab


def leave(tab: BrowserTab, how: str) -> None:
    """Leave the view in one of three ways; the camera was this view's."""
    match how:
        case "view":
            tab.open("People")
        case "source":
            tab.page.get_by_label("Files", exact=True).check()
        case _:
            tab.press("Sign out")
            expect(tab.page.get_by_role("heading", level=1, name="Sign in")).to_be_visible()


def states(tab: BrowserTab) -> list[str]:
    found: list[str] = tab.page.evaluate("window.tracks.map((each) => each.readyState)")
    return found


def checks(tab: BrowserTab) -> int:
    return sum(url.endswith("/v1/photos/check") for url in tab.requests)


def test_nothing_is_sent_once_the_camera_was_left(open_tab: OpenTab, demo: Served) -> None:
    tab = watched(open_tab, demo)
    page = tab.page
    for number, how in enumerate(("view", "source", "sign-out"), start=1):
        # Left while the video is about to play.
        tab.open("Service")
        tab.open("Enroll")
        page.evaluate("() => { window.playing = new Promise((done) => { window.goOn = done; }); }")
        page.get_by_label("Camera", exact=True).check()
        tab.press("Start camera")
        tab.wait_for("count => window.tracks.length === count", number)
        leave(tab, how)
        page.evaluate("window.goOn()")
        tab.wait_for("() => window.tracks.every((track) => track.readyState === 'ended')")
    page.wait_for_timeout(1200)
    assert checks(tab) == 0
    for how in ("view", "sign-out"):
        # Left while frames go out.
        tab.sign_in(demo.token)
        tab.start_camera()
        expect(page.locator(".guidance:not([data-state=idle])")).to_be_visible()
        leave(tab, how)
        assert set(states(tab)) == {"ended"}
        sent = checks(tab)
        assert sent > 0
        page.wait_for_timeout(1300)
        assert checks(tab) == sent


def test_a_camera_that_stops_is_said_and_can_be_started_again(
    open_tab: OpenTab, demo: Served, camera: FakeCamera
) -> None:
    camera.shows()
    tab = watched(open_tab, demo)
    page = tab.page
    button = page.get_by_role("button", name="Start camera")
    for event in ("ended", "mute", "pagehide"):
        tab.start_camera()
        expect(button).to_be_hidden()
        page.evaluate(
            "name => (name === 'pagehide' ? window : window.tracks.at(-1))"
            ".dispatchEvent(new Event(name))",
            event,
        )
        tab.guided("The camera has stopped.")
        expect(button).to_be_focused()
        expect(page.locator("video:visible")).to_have_count(0)
        assert set(states(tab)) == {"ended"}
    # The pack has no detector: a frame that is no square would be refused before it is looked at.
    tab.start_camera()
    tab.guided("The photo is not good enough")
    leave(tab, "source")
    asked: list[str] = []
    wait = refused(429, "rate_limited", "too many requests", wait=30)
    page.route("**/v1/photos/check", lambda route: (asked.append("check"), route.fulfill(**wait)))
    tab.start_camera()
    assert states(tab)[-1] == "live"
    # It waits as long as it is told.
    tab.guided("Guidance is paused.")
    page.wait_for_timeout(2500)
    assert asked == ["check"]


def jpeg(name: str, data: bytes) -> FilePayload:
    return {"name": name, "mimeType": "image/jpeg", "buffer": data}


def test_photos_are_decoded_one_at_a_time(open_tab: OpenTab, demo: Served) -> None:
    out = io.BytesIO()
    drawn = demo.settings.data_dir / "people" / "person-2" / "0.png"
    Image.open(drawn).resize((1700, 1700)).save(out, "JPEG")
    tab = watched(open_tab, demo)
    page = tab.page
    tab.open("Enroll")
    tab.choose_files(*(jpeg(f"{n}.jpg", out.getvalue()) for n in range(4)))
    tab.good(4)
    assert page.evaluate("window.bitmaps") == {"open": 0, "most": 1, "all": 4}
    # A browser that cannot make the smaller copy sends the photo, and says why it takes no frame.
    page.evaluate("() => { HTMLCanvasElement.prototype.toBlob = (done) => done(null); }")
    tab.choose_files(jpeg("5.jpg", out.getvalue()))
    tab.good(5)
    assert page.evaluate("window.bitmaps.open") == 0
    tab.start_camera()
    tab.press("Take 3 photos")
    tab.guided("The browser could not take a photo.")
