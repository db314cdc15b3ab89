"""The page asks for head movements where the service does, and takes frames by the clock."""

import re
from collections.abc import Mapping
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from tests.api.deployment import images
from tests.api.living import calibrated
from tests.clients.javascript.conftest import require_client
from tests.marked_heads import draw, encoded, frame, head
from tests.web.browser_tab import BrowserTab
from tests.web.camera import SIZE, FakeCamera
from tests.web.client_page import application, for_browsers
from tests.web.conftest import OpenTab
from tests.web.deployments import ANNA
from tests.web.moving_head import camera_script
from tests.web.served import Served, serving
from tests.web.walk import START
from veilface_client import Client

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

# In a language in which a movement is called by its name; no runtime, for nothing is lifted.
LOGIN = """
import { defineLogin, WORDS } from "veilface-client/login";

defineLogin();
const login = document.querySelector("veilface-login");
login.setAttribute("liveness", "head-movements");
login.authorize = async () => (await fetch("/login/token", { method: "POST" })).json();
const names = Object.keys(WORDS.movements).map((name) => [name, name]);
login.words = { start: "Kamera an", movements: Object.fromEntries(names) };
"""
SAID = 'document.querySelector("veilface-login")?.shadowRoot?.querySelector("output").textContent'


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
    expect(page.locator(".head-movements .outline")).to_be_visible()
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


def test_who_turns_the_wrong_way_is_rejected(open_tab: OpenTab, moving: Served) -> None:
    other = '(asked) => ({turn_left: "turn_right", look_up: "look_down"})[asked] ?? '
    tab = opened(open_tab, moving, other + '(asked === "front" ? asked : "turn_left")')
    tab.press(START)
    verdict = tab.page.locator(".verdict.reject")
    expect(verdict).to_contain_text(re.compile("a movement was not seen|another order"))
    expect(verdict).to_contain_text("a living person")
    expect(verdict).to_contain_text("Follow each movement")


def test_a_photo_before_the_browsers_own_camera_is_rejected(
    open_tab: OpenTab, moving: Served, camera: FakeCamera, tmp_path: Path
) -> None:
    still = tmp_path / "still.png"
    Image.fromarray(draw(head(), ANNA)).resize((SIZE[1], SIZE[1])).save(still)
    camera.shows(still)
    tab = opened(open_tab, moving)
    tab.press(START)
    expect(tab.page.locator(".verdict.reject")).to_contain_text("the head did not turn")


def test_who_sends_photos_is_not_told_to_move(
    open_tab: OpenTab, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    deployment = calibrated(tmp_path)
    flags = ["--data-dir", str(deployment.settings.data_dir)]
    flags += ["--pack", str(deployment.settings.pack), "--liveness", "passive"]
    dark = tmp_path / "dark.png"
    dark.write_bytes(encoded(draw(head(), ANNA, background=0)))
    with serving(tmp_path, deployment.settings, *flags, token=deployment.token) as served:
        with served.client() as client:
            files = images(frame(person=ANNA))
            assert client.put("/v1/subjects/anna/enrollment", files=files).status_code == 201
        tab = opened(open_tab, served)
        page = tab.page
        tab.choose_files(dark)
        tab.press("Verify")
        expect(page.locator(".verdict.reject")).to_contain_text("Take new photos")
        expect(page.locator(".verdict")).not_to_contain_text("movement")


def test_leaving_ends_the_camera_and_sends_nothing(open_tab: OpenTab, moving: Served) -> None:
    tab = opened(open_tab, moving, "(asked) => asked")
    page = tab.page
    tab.press(START)
    expect(page.locator(".movement")).to_be_visible()
    tab.open("People")
    assert page.evaluate("window.cameraTrack.readyState") == "ended"
    page.wait_for_timeout(3000)
    assert not any(url.endswith(("/v1/challenges", "/verify")) for url in tab.requests)


@pytest.mark.parametrize(
    ("shown", "says"),
    [("(asked) => asked", "Welcome."), ('() => "front"', "The movements were not seen.")],
)
def test_the_element_asks_for_movements_and_says_that_photos_are_sent(
    browser: Browser, moving: Served, shown: str, says: str
) -> None:
    require_client()
    context = browser.new_context()
    with Client(moving.url, moving.token) as client:

        def authorize(_: Mapping[str, str]) -> dict[str, str]:
            return {"subject": "anna", "token": client.create_token("anna", "verify").token}

        try:
            with application(moving.url, authorize) as served:
                served.program = for_browsers(LOGIN)
                tab = BrowserTab.of(context, served.url + "/")
                tab.page.add_init_script(camera_script(shown, person=ANNA, asked=SAID))
                tab.page.goto(tab.url)
                told = tab.page.locator("veilface-login p")
                expect(told).to_contain_text("Photos of that are sent to the service")
                start = tab.page.get_by_role("button", name="Kamera an")
                expect(start).to_have_accessible_description(re.compile("Photos of that are sent"))
                start.click()
                expect(tab.page.get_by_label("Your camera")).to_be_visible()
                tab.page.get_by_role("button", name="Log in").click()
                expect(tab.page.locator("veilface-login output")).to_contain_text(says)
                sent = served.recording.sent
                assert sent.count(b"POST /v1/challenges ") == 1
                assert sent.count(b'filename="photo"') == 10
                assert b"/v1/pack" not in sent
                assert b"/v1/contract" not in sent
                assert tab.complaints == tab.violations() == []
        finally:
            context.close()
