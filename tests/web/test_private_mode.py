"""Private mode of the page: no face leaves the browser, and where one must, that is said."""

import base64
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Route, expect

from models.pack import ModelPack
from tests.clients.conftest import Running
from tests.clients.javascript.conftest import require_client
from tests.clients.proxy import Proxy
from tests.clients.recorded import faces_of, requests_in
from tests.leaks import as_bytes
from tests.patience import wait_until
from tests.web.access import assert_accessible
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import OTHER, WHO
from tests.web.passkeys import Authenticator
from tests.web.served import Served
from tests.web.walk import walk_private

pytestmark = pytest.mark.long
HOLD_PICTURES = """() => {
  const { createImageBitmap } = window;
  window.createImageBitmap = async (...given) => {
    await new Promise((done) => (window.release = done));
    return createImageBitmap(...given);
  };
}"""
COUNT_LOOKS = """() => {
  window.looks = 0;
  const { toBlob } = HTMLCanvasElement.prototype;
  HTMLCanvasElement.prototype.toBlob = function (...given) {
    window.looks += 1;
    return toBlob.apply(this, given);
  };
}"""


def choose(tab: BrowserTab, *photos: Path) -> None:
    """Choose files that will do, in the place of those before or beside them."""
    tab.choose_files(*photos)
    tab.good(len(photos))


@pytest.fixture
def recording(running: Running) -> Iterator[Proxy]:
    require_client()
    with Proxy(running.port) as proxy:
        yield proxy


@pytest.fixture
def served(running: Running, recording: Proxy) -> Served:
    """The service behind the recording proxy, under a name, as passkeys need one."""
    settings = running.deployment.settings
    there = Served(
        recording.url.replace("127.0.0.1", "localhost"),
        running.deployment.token,
        settings,
        settings.data_dir / "absent.log",
    )
    # Other modules of this package enroll her as well.
    with there.client() as client:
        client.delete("/v1/subjects/anna")
    recording.forget()
    return there


def test_axe_finds_nothing_in_private_mode(
    served: Served, open_tab: OpenTab, camera: FakeCamera, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(served, sign_in=None)
    for name in walk_private(tab, served, camera, people[WHO]):
        assert_accessible(tab, name)


def test_a_face_never_leaves_the_browser(
    recording: Proxy,
    served: Served,
    open_tab: OpenTab,
    camera: FakeCamera,
    pack: ModelPack,
    people: dict[str, list[Path]],
) -> None:
    own, other = people[WHO], people[OTHER]
    camera.shows(own[0])
    tab = open_tab(served)
    page = tab.page
    Authenticator.of(page)
    tab.open("Enroll")
    expect(page.get_by_role("switch", name="Private mode")).to_be_checked()
    tab.name_person("anna")
    tab.start_camera()
    tab.guided("Good: one face")
    tab.press("Take 3 photos")
    expect(page.locator(".tray .found:not([hidden])")).to_have_count(3)
    tab.choose_files(own[1])
    tab.good(4)
    tab.lock()
    tab.press("Enroll")
    expect(page.locator(".verdict")).to_contain_text("Enrolled")
    expect(page.locator(".verdict")).to_contain_text("Holder keyneeded at every verification")

    page.get_by_role("link", name="Verify this person").click()
    # Else the files may be chosen in the view that is about to go.
    expect(page.get_by_role("heading", name="Verify", exact=True)).to_be_visible()
    choose(tab, own[2])
    expect(page.get_by_label("Use the passkey")).to_be_checked()
    tab.press("Verify")
    expect(page.locator(".verdict.accept")).to_contain_text("Accepted")
    choose(tab, other[0])
    tab.press("Verify")
    expect(page.locator(".verdict.reject")).to_contain_text("Rejected")

    sent = recording.sent
    calls, rest = requests_in(sent)
    assert rest == 0
    assert {call for call in calls if not call.startswith("GET ")} == {
        "POST /v1/tokens",
        "PUT /v1/subjects/*/enrollment",
        "POST /v1/subjects/*/verify",
    }
    probe = calls["POST /v1/subjects/*/verify"]
    assert probe["members"] == ["holder_key", "template"]
    assert calls["PUT /v1/subjects/*/enrollment"]["members"] == ["holder_key", "template"]
    search = faces_of(pack, {WHO: own[:3], OTHER: other[:1]})
    assert search.find(sent) == []
    embedding = pack.embed_photo(own[1].read_bytes()).embedding
    for planted in (as_bytes(embedding, "float32"), own[1].read_bytes()):
        assert search.find(sent + planted), "it would have been found"


def bodies_of(sent: bytes, request: str) -> list[dict[str, str]]:
    """The JSON bodies of a request, each time that it was sent."""
    bodies = []
    for head in re.finditer(rb"%s HTTP/1\.1\r\n(.*?)\r\n\r\n" % request.encode(), sent, re.DOTALL):
        (length,) = re.findall(rb"(?i)content-length: (\d+)", head[1])
        bodies.append(json.loads(sent[head.end() : head.end() + int(length)]))
    return bodies


def test_the_same_photos_are_lifted_once(
    recording: Proxy, served: Served, open_tab: OpenTab, people: dict[str, list[Path]]
) -> None:
    """Two lifts of them would give the embedding away: to replace, and to ask again."""
    own = people[WHO]
    tab = open_tab(served)
    page = tab.page
    tab.open("Enroll")
    tab.name_person("anna")
    for photos in (own[:1], own[1:3]):
        choose(tab, *photos)
        tab.press("Enroll")
        if photos == own[:1]:
            expect(page.locator(".verdict")).to_contain_text("Earlier enrollmentnone")
    dialog = page.get_by_role("dialog", name="Replace anna’s enrollment?")
    dialog.get_by_role("button", name="Keep").click()
    tab.press("Enroll")
    dialog.get_by_role("button", name="Replace").click()
    expect(page.locator(".verdict")).to_contain_text("Earlier enrollmentreplaced")
    # Chosen anew, in another order, and by another policy for faces.
    page.get_by_text("Options:").click()
    page.get_by_label("Others are in the picture").check()
    choose(tab, own[2], own[1])
    tab.press("Enroll")
    dialog.get_by_role("button", name="Replace").click()
    expect(page.locator(".verdict")).to_contain_text("Earlier enrollmentreplaced")
    first, *again = [
        each["template"] for each in bodies_of(recording.sent, "PUT /v1/subjects/anna/enrollment")
    ]
    assert len(again) == 5
    assert len(set(again)) == 1
    assert first not in again

    page.get_by_role("link", name="Verify this person").click()
    # Else the files may be chosen in the view that is about to go.
    expect(page.get_by_role("heading", name="Verify", exact=True)).to_be_visible()
    choose(tab, own[1])
    tab.press("Verify")
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("This photo was used to enroll already")
    expect(alert).to_contain_text("Choose another photo.")
    expect(page.locator(".tray .seen[data-state=bad]")).to_contain_text("used to enroll")
    for photo in (own[3], own[4], own[3]):
        choose(tab, photo)
        tab.press("Verify")
        expect(page.locator(".verdict")).to_be_visible()
    probes = [
        each["template"] for each in bodies_of(recording.sent, "POST /v1/subjects/anna/verify")
    ]
    assert probes[0] == probes[2] != probes[1]

    # Two attempts at once, as two views make them while the graphs load: one of them lifts.
    other = next(photos for name, photos in people.items() if name != WHO)[0]
    refused = page.evaluate(
        """async (text) => {
          const { enroll, verify } = await import("/assets/private.js");
          const photo = new Blob([Uint8Array.from(atob(text), (each) => each.charCodeAt(0))]);
          const attempts = [
            verify("anna", { photos: [photo], level: "fmr-1e-2" }),
            enroll("emil", { photos: [photo] }, null),
          ];
          return (await Promise.allSettled(attempts)).map(({ reason }) => reason?.code ?? null);
        }""",
        base64.b64encode(other.read_bytes()).decode(),
    )
    assert refused == [None, "lifted_before"]


def test_signing_out_ends_an_attempt_and_forgets_the_switch(
    recording: Proxy, served: Served, open_tab: OpenTab, people: dict[str, list[Path]]
) -> None:
    """A lift that ends afterwards is neither kept nor sent, nor is a token asked for."""
    tab = open_tab(served)
    page = tab.page
    switch = page.get_by_role("switch", name="Private mode")
    tab.open("Enroll")
    tab.name_person("a-person-who-signs-out")
    choose(tab, people[WHO][0])
    page.evaluate(HOLD_PICTURES)
    button = page.locator("form button[type=submit]").element_handle()
    tab.press("Enroll")
    tab.wait_for("window.release !== undefined")
    tab.press("Sign out")
    expect(page.get_by_label("API key")).to_be_visible()
    recording.forget()
    page.evaluate("window.release()")
    wait_until(lambda: button.text_content() == "Enroll", what="the attempt has ended")
    assert b"/v1/tokens" not in recording.sent
    assert b"a-person-who-signs-out" not in recording.sent

    sign_in_again(tab, served)
    expect(switch).to_be_checked()
    switch.uncheck()
    tab.press("Sign out")
    sign_in_again(tab, served)
    expect(switch).to_be_checked()


def sign_in_again(tab: BrowserTab, served: Served) -> None:
    page = tab.page
    page.get_by_label("API key").fill(served.token)
    tab.press("Sign in")
    expect(page.get_by_role("navigation", name="Views")).to_be_visible()


def test_what_private_mode_cannot_serve_goes_to_the_service_and_that_is_said(
    recording: Proxy,
    served: Served,
    open_tab: OpenTab,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    """A level that is not calibrated for it: switched off, with the reason; and on at another."""
    with served.client() as client:
        photo = {"images": people[WHO][0].read_bytes()}
        assert client.put("/v1/subjects/anna/enrollment", files=photo).is_success
    tab = open_tab(served, sign_in=None)
    page = tab.page

    def without_a_level(route: Route) -> None:
        answer = route.fetch()
        contract = answer.json()
        for entry in contract["calibrations"]:
            if entry["mode"] == "s2s":
                entry["levels"] = [each for each in entry["levels"] if each["name"] != "fmr-1e-3"]
        route.fulfill(response=answer, json=contract)

    page.route("**/v1/contract", without_a_level)
    tab.sign_in(served.token)
    switch = page.get_by_role("switch", name="Private mode")
    tab.name_person("anna")
    level = page.get_by_label("Level")
    level.select_option("fmr-1e-3")
    expect(switch).to_be_disabled()
    expect(switch).not_to_be_checked()
    said = page.locator(".private [role=status]")
    expect(said).to_contain_text("cannot serve this level: it is not calibrated")
    expect(said).to_contain_text("Photos are sent to the service")
    assert_accessible(tab, "private-mode-off")
    choose(tab, people[WHO][1])
    recording.forget()
    tab.press("Verify")
    expect(page.locator(".verdict.accept")).to_be_visible()
    assert people[WHO][1].read_bytes() in recording.sent

    level.select_option("fmr-1e-2")
    expect(switch).to_be_checked()
    recording.forget()
    tab.press("Verify")
    expect(page.locator(".verdict")).to_be_visible()
    assert people[WHO][1].read_bytes() not in recording.sent
    # What the promise was given for is not sent without it, by a change of the level alone.
    camera.shows(people[WHO][0])
    tab.start_camera()
    tab.guided("Good: one face")
    recording.forget()
    level.select_option("fmr-1e-3")
    tab.guided("The camera is off.")
    expect(page.locator(".tray li")).to_have_count(0)
    expect(said).to_contain_text("photos that were chosen in private mode are removed")
    level.select_option("fmr-1e-2")
    expect(switch).to_be_checked()
    assert b"/v1/photos/check" not in recording.sent
    # One state for the tab: what is switched off here is off in the other view.
    switch.uncheck()
    expect(said).to_contain_text("Photos are sent to the service")
    tab.open("Enroll")
    expect(switch).not_to_be_checked()
    expect(switch).to_be_enabled()


def test_what_keeps_private_mode_from_working_is_said_and_nothing_else_is_sent(
    recording: Proxy,
    served: Served,
    open_tab: OpenTab,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    """A graph that is not the contract's: no photo goes to the service in its place."""
    tab = open_tab(served)
    page = tab.page

    def altered(route: Route) -> None:
        answer = route.fetch()
        route.fulfill(response=answer, body=answer.body()[:-1] + b"?")

    page.route(re.compile(r"/v1/pack/[0-9a-f]{64}$"), altered)
    camera.shows(people[WHO][0])
    tab.start_camera()
    tab.guided("Guidance is unavailable right now")
    page.evaluate(COUNT_LOOKS)
    tab.wait_for("window.looks >= 2")  # and they do not try again
    tab.name_person("anna")
    tab.choose_files(people[WHO][0])
    tab.press("Verify")
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("use the pack that the contract was calibrated with")
    expect(alert).to_contain_text("private_mode")
    calls, rest = requests_in(recording.sent)
    assert rest == 0
    assert {call for call in calls if not call.startswith("GET ")} == {"POST /v1/tokens"}
    assert calls["POST /v1/tokens"]["times"] == 2, "one for the looks, one for the attempt"
    page.unroute(re.compile(r"/v1/pack/[0-9a-f]{64}$"))
