"""The page asks for head movements where the service does, and takes frames by the clock."""

import re
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import expect

from tests.marked_heads import draw, head
from tests.web.browser_tab import BrowserTab
from tests.web.camera import SIZE, FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import ANNA
from tests.web.moving_head import camera_script
from tests.web.served import Served
from tests.web.walk import START

pytestmark = pytest.mark.long

COUNT = """
window.sentFrames = [];
window.spokenWords = [];
document.addEventListener("DOMContentLoaded", () => new MutationObserver(() => {
  const words = document.querySelector(".movement")?.textContent;
  if (words && words !== window.spokenWords.at(-1)) window.spokenWords.push(words);
}).observe(document.body, { subtree: true, childList: true, characterData: true }));
const send = window.fetch;
window.fetch = (path, options) => {
  if (path.endsWith("/verify")) window.sentFrames.push(options.body.getAll("images").length);
  return send(path, options);
};
"""


def opened(open_tab: OpenTab, served: Served, shown: str | None = None) -> BrowserTab:
    tab = open_tab(served, sign_in=None)
    tab.page.add_init_script(COUNT)
    if shown is not None:
        tab.page.add_init_script(camera_script(shown, person=ANNA))
    tab.sign_in(served.token)
    tab.name_person("anna")
    return tab


def test_who_follows_the_movements_is_accepted(open_tab: OpenTab, moving: Served) -> None:
    tab = opened(open_tab, moving, "(asked) => asked")
    page = tab.page
    expect(page.locator(".picker")).to_be_hidden()
    expect(page.get_by_text("cannot turn your head, ask the operator")).to_be_visible()
    with page.expect_response(re.compile("/v1/challenges$")) as given:
        tab.press(START)
    expect(page.locator(".movement")).to_be_visible()
    expect(page.locator(".head-movements .viewfinder")).to_be_visible()
    asked = given.value.json()["movements"]
    expect(page.locator(".verdict.accept")).to_contain_text("Accepted")
    expect(page.locator(".verdict")).to_contain_text("passed")
    assert page.evaluate("window.sentFrames") == [10]
    poses = page.evaluate("window.shownPoses")
    assert poses == ["front", *(pose for each in asked for pose in (each, "front"))]
    # Who was asked to come closer is told to move back.
    told = " ".join(page.evaluate("window.spokenWords"))
    assert ("Move back" in told) == ("come_closer" in asked) == ("Come closer" in told)
    # The camera is off, and the form is there again.
    assert page.evaluate("window.cameraTrack.readyState") == "ended"
    expect(page.locator(".movement")).to_be_hidden()
    expect(page.get_by_role("button", name=START)).to_be_enabled()


def test_a_photo_before_the_browsers_own_camera_is_rejected(
    open_tab: OpenTab, moving: Served, camera: FakeCamera, tmp_path: Path
) -> None:
    still = tmp_path / "still.png"
    Image.fromarray(draw(head(), ANNA)).resize((SIZE[1], SIZE[1])).save(still)
    camera.shows(still)
    tab = opened(open_tab, moving)
    tab.press(START)
    expect(tab.page.locator(".verdict.reject")).to_contain_text("failed (no turn)")


def test_leaving_ends_the_camera_and_sends_nothing(open_tab: OpenTab, moving: Served) -> None:
    tab = opened(open_tab, moving, "(asked) => asked")
    page = tab.page
    tab.press(START)
    expect(page.locator(".movement")).to_be_visible()
    tab.open("People")
    assert page.evaluate("window.cameraTrack.readyState") == "ended"
    page.wait_for_timeout(3000)
    assert not any(url.endswith(("/v1/challenges", "/verify")) for url in tab.requests)
