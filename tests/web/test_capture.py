"""The camera ends when it should, and what is checked is what is sent."""

import io
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from PIL import Image
from playwright.sync_api import expect

from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.served import Served

pytestmark = pytest.mark.long

NO_FACE = "No face found. Come closer, and face the camera with your head upright."

WATCH = """
window.tracks = [];
window.sent = [];
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
const send = window.fetch;
window.fetch = (path, options) => {
  for (const [, part] of options?.body ?? [])
    if (part instanceof Blob) window.sent.push([path, part]);
  return send(path, options);
};
"""
SENT = """
async () => Promise.all(window.sent.map(async ([path, blob]) => {
  const bitmap = await createImageBitmap(blob);
  const bytes = new Uint8Array(await blob.arrayBuffer());
  return {path, type: blob.type, width: bitmap.width, height: bitmap.height, text: bytes.join()};
}))
"""


def watched(open_tab: OpenTab, served: Served) -> BrowserTab:
    tab = open_tab(served, sign_in=None)
    tab.page.add_init_script(WATCH)
    tab.sign_in(served.token)
    return tab


def start(tab: BrowserTab) -> None:
    tab.page.get_by_label("Camera", exact=True).check()
    tab.page.get_by_role("button", name="Start camera").click()


def leave(tab: BrowserTab, how: str, token: str) -> None:
    """Leave the view in one of three ways; the camera was this view's."""
    match how:
        case "view":
            tab.open("People")
        case "source":
            tab.page.get_by_label("Files").check()
        case _:
            tab.page.get_by_role("button", name="Sign out").click()
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
        tab.open("Verify")
        page.evaluate("() => { window.playing = new Promise((done) => { window.goOn = done; }); }")
        start(tab)
        tab.wait_for("count => window.tracks.length === count", number)
        leave(tab, how, demo.token)
        page.evaluate("window.goOn()")
        tab.wait_for("() => window.tracks.every((track) => track.readyState === 'ended')")
    page.wait_for_timeout(1200)
    assert checks(tab) == 0
    for how in ("view", "sign-out"):
        # Left while frames go out.
        tab.sign_in(demo.token)
        start(tab)
        expect(page.locator(".guidance:not([data-state=idle])")).to_be_visible()
        leave(tab, how, demo.token)
        assert set(states(tab)) == {"ended"}
        sent = checks(tab)
        assert sent > 0
        page.wait_for_timeout(1300)
        assert checks(tab) == sent


def test_a_camera_that_stops_is_said_and_can_be_started_again(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = watched(open_tab, demo)
    page = tab.page
    button = page.get_by_role("button", name="Start camera")
    for event in ("ended", "mute", "pagehide"):
        start(tab)
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
    start(tab)
    expect(page.get_by_role("button", name="Take 3 photos")).to_be_visible()
    assert states(tab)[-1] == "live"


def test_the_photo_that_is_sent_was_itself_checked(
    open_tab: OpenTab, real: Served, camera: FakeCamera, people: dict[str, list[Path]]
) -> None:
    camera.shows(people["Ashanti"][0])
    tab = watched(open_tab, real)
    page = tab.page
    page.get_by_label("Person's id").fill("nobody-there")
    tab.take_photos()
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(3)
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("not_enrolled")
    taken = page.evaluate(SENT)
    assert_sent_as_checked(taken, (640, 480), photos=3)
    assert {(each["width"], each["height"]) for each in taken} == {(640, 480), (480, 360)}

    # A large photo is made smaller once; one that is small stays as it is, byte for byte.
    small = people["Ashanti"][1].read_bytes()
    large = io.BytesIO()
    Image.open(io.BytesIO(small)).resize((2400, 1800)).save(large, "JPEG")
    page.get_by_label("Files").check()
    for data, size in ((large.getvalue(), (1600, 1200)), (small, (250, 250))):
        page.evaluate("window.sent.length = 0")
        file: Any = {"name": "photo.jpg", "mimeType": "image/jpeg", "buffer": data}
        page.get_by_label("Photos: JPEG").set_input_files(file)
        expect(page.locator(".tray .seen[data-state=good]")).to_have_count(1)
        page.get_by_role("button", name="Verify", exact=True).click()
        expect(page.get_by_role("alert")).to_contain_text("not_enrolled")
        assert_sent_as_checked(page.evaluate(SENT), size)
    assert page.evaluate(SENT)[-1]["text"] == ",".join(map(str, small))

    # A photo that would be refused is not taken.
    camera.shows()
    page.get_by_label("Camera", exact=True).check()
    page.get_by_role("button", name="Remove photo").click()
    page.get_by_role("button", name="Start camera").click()
    page.get_by_role("button", name="Take 3 photos").click()
    expect(page.locator(".refused")).to_have_text(f"None of 3 photos taken. {NO_FACE}")
    expect(page.locator(".tray li")).to_have_count(0)


def assert_sent_as_checked(
    sent: list[dict[str, Any]], size: tuple[int, int], *, photos: int = 1
) -> None:
    # The camera goes on, so that a frame may be checked after the photos were sent.
    sending = [n for n, each in enumerate(sent) if each["path"].endswith("/verify")]
    assert len(sending) == photos
    checked = [each for each in sent[: sending[0]] if each["path"] == "/v1/photos/check"]
    for number in sending:
        assert (sent[number]["width"], sent[number]["height"]) == size
        assert sent[number]["text"] in {each["text"] for each in checked}


BLACK = """
window.shots = [];
const encode = HTMLCanvasElement.prototype.toBlob;
HTMLCanvasElement.prototype.toBlob = function (...given) {
  if (this.width > 480) {
    window.shots.push(performance.now());
    if (window.shots.length === 2) this.getContext("2d").fillRect(0, 0, this.width, this.height);
  }
  return encode.apply(this, given);
};
"""


def test_one_click_takes_three_photos_and_drops_what_would_not_do(
    open_tab: OpenTab, real: Served, camera: FakeCamera, people: dict[str, list[Path]]
) -> None:
    camera.shows(people["Ashanti"][0])
    tab = watched(open_tab, real)
    page = tab.page
    tab.open("Enroll")
    start(tab)
    tab.guided("Good: one face")
    page.evaluate(f"() => {{ {BLACK} }}")
    page.get_by_role("button", name="Take 3 photos").click()
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(2)
    expect(page.locator(".refused")).to_have_text(f"2 of 3 photos taken. {NO_FACE}")
    expect(page.get_by_role("button", name="Take 3 photos")).to_be_enabled()
    times = page.evaluate("window.shots")
    assert len(times) == 3
    assert min(later - earlier for earlier, later in pairwise(times)) > 250
    # In an enrollment a second burst is added to the first.
    page.get_by_role("button", name="Take 3 photos").click()
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(5)
    expect(page.locator(".refused")).to_be_empty()


def test_photos_are_decoded_one_at_a_time(open_tab: OpenTab, demo: Served) -> None:
    out = io.BytesIO()
    Image.open(demo.settings.data_dir / "people" / "person-2" / "0.png").resize((1700, 1700)).save(
        out, "JPEG"
    )
    tab = watched(open_tab, demo)
    page = tab.page
    tab.open("Enroll")
    page.get_by_label("Files").check()
    page.get_by_label("Photos: JPEG").set_input_files(
        [{"name": f"{n}.jpg", "mimeType": "image/jpeg", "buffer": out.getvalue()} for n in range(4)]
    )
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(4)
    assert page.evaluate("window.bitmaps") == {"open": 0, "most": 1, "all": 4}
    # A browser that cannot make the smaller copy sends the photo, and says why it takes no frame.
    page.evaluate("() => { HTMLCanvasElement.prototype.toBlob = (done) => done(null); }")
    page.get_by_label("Photos: JPEG").set_input_files(
        {"name": "5.jpg", "mimeType": "image/jpeg", "buffer": out.getvalue()}
    )
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(5)
    assert page.evaluate("window.bitmaps.open") == 0
    page.get_by_label("Camera", exact=True).check()
    page.get_by_role("button", name="Start camera").click()
    page.get_by_role("button", name="Take 3 photos").click()
    expect(page.locator(".refused")).to_have_text(
        "None of 3 photos taken. The browser could not take a photo."
    )
