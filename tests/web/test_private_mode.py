"""Private mode of the page: no face leaves the browser, and where one must, that is said."""

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
from tests.web.access import assert_accessible
from tests.web.answers import PendingRequests
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import OTHER, WHO
from tests.web.passkeys import Authenticator
from tests.web.served import Served
from tests.web.walk import walk_private

pytestmark = pytest.mark.long

NO_CAMERA = """
navigator.mediaDevices.getUserMedia = async () => {
  throw new DOMException("Requested device not found", "NotFoundError");
};
null;
"""


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


def attempt(tab: BrowserTab, button: str, *, start: str = "Start camera") -> None:
    """Take and send photos by the element."""
    tab.press(start)
    tab.press(button)


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
    authenticator = Authenticator.of(page)
    verdict = page.locator(".verdict")
    tab.open("Enroll")
    expect(page.get_by_role("switch", name="Private mode")).to_be_checked()
    tab.name_person("anna")
    tab.lock()
    attempt(tab, "Enroll")
    expect(verdict).to_contain_text("Earlier enrollmentnone")
    expect(verdict).to_contain_text("Holder keyneeded at every verification")
    assert authenticator.passkeys() == 1

    # Replaced only where the visitor says so, which is asked before the token.
    dialog = page.get_by_role("dialog", name="Replace anna’s enrollment?")
    attempt(tab, "Enroll")
    dialog.get_by_role("button", name="Keep").click()
    expect(page.locator("veilface-login output")).to_have_text("The earlier enrollment stays.")
    attempt(tab, "Enroll", start="Try again")
    dialog.get_by_role("button", name="Replace").click()
    expect(verdict).to_contain_text("Earlier enrollmentreplaced")

    page.get_by_role("link", name="Verify this person").click()
    expect(page.get_by_label("Use the passkey")).to_be_checked()
    camera.shows(own[1])
    attempt(tab, "Verify")
    tab.is_decided("accept")
    camera.shows(other[0])
    attempt(tab, "Verify")
    tab.is_decided("reject")

    sent = recording.sent
    calls, rest = requests_in(sent)
    assert rest == 0
    assert {call for call in calls if not call.startswith("GET ")} == {
        "POST /v1/tokens",
        "PUT /v1/subjects/*/enrollment",
        "POST /v1/subjects/*/verify",
    }
    for call in ("PUT /v1/subjects/*/enrollment", "POST /v1/subjects/*/verify"):
        assert calls[call]["members"] == ["holder_key", "template"]
    search = faces_of(pack, {WHO: own[:2], OTHER: other[:1]})
    assert search.find(sent) == []
    embedding = pack.embed_photo(own[1].read_bytes()).embedding
    for planted in (as_bytes(embedding, "float32"), own[1].read_bytes()):
        assert search.find(sent + planted), "it would have been found"


def test_signing_out_ends_an_attempt_and_forgets_the_switch(
    recording: Proxy,
    served: Served,
    open_tab: OpenTab,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    camera.shows(people[WHO][0])
    tab = open_tab(served)
    page = tab.page
    switch = page.get_by_role("switch", name="Private mode")
    tab.open("Enroll")
    tab.name_person("a-person-who-signs-out")
    tokens = PendingRequests(page, "**/v1/tokens")
    attempt(tab, "Enroll")
    tokens.wait()
    tab.press("Sign out")
    expect(page.get_by_label("API key")).to_be_visible()
    for route in tokens.routes:
        route.abort()
    page.unroute("**/v1/tokens")
    tab.complaints[:] = [each for each in tab.complaints if "net::ERR" not in each]

    tab.sign_in(served.token)
    expect(switch).to_be_checked()
    switch.uncheck()
    tab.press("Sign out")
    tab.sign_in(served.token)
    expect(switch).to_be_checked()
    assert b"a-person-who-signs-out/" not in recording.sent


def test_what_private_mode_cannot_serve_goes_to_the_service_and_that_is_said(
    recording: Proxy, served: Served, open_tab: OpenTab, people: dict[str, list[Path]]
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
    element = page.locator("veilface-login")
    tab.name_person("anna")
    level = page.get_by_label("Level")
    level.select_option("fmr-1e-3")
    expect(switch).to_be_disabled()
    expect(switch).not_to_be_checked()
    said = page.locator(".private [role=status]")
    expect(said).to_contain_text("cannot serve this level: it is not calibrated")
    expect(said).to_contain_text("Photos are sent to the service")
    expect(element).to_be_hidden()
    assert_accessible(tab, "private-mode-off")
    tab.choose_files(people[WHO][1])
    tab.good(1)
    tab.press("Verify")
    tab.is_decided("accept")
    assert people[WHO][1].read_bytes() in recording.sent

    level.select_option("fmr-1e-2")
    expect(switch).to_be_checked()
    expect(element).to_be_visible()
    expect(page.locator(".picker")).to_be_hidden()
    # One state for the tab: what is switched off here is off in the other view.
    switch.uncheck()
    expect(said).to_contain_text("Photos are sent to the service")
    tab.open("Enroll")
    expect(switch).not_to_be_checked()
    expect(switch).to_be_enabled()


def test_photos_that_were_chosen_before_private_mode_are_not_sent(
    recording: Proxy, served: Served, open_tab: OpenTab, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(served)
    page = tab.page
    switch = page.get_by_role("switch", name="Private mode")
    switch.uncheck()
    tab.choose_files(people[WHO][0])
    tab.good(1)
    recording.forget()
    switch.check()
    tab.name_person("anna")
    page.get_by_label("Person’s id").press("Enter")
    page.locator("form").evaluate("(form) => form.requestSubmit()")
    page.get_by_text("Options", exact=True).click()
    page.get_by_label("use the largest face").check()
    switch.uncheck()
    expect(page.locator(".tray li")).to_have_count(0)
    tab.open("People")
    expect(page.get_by_text("Nobody is enrolled yet")).to_be_visible()
    assert {call for call in requests_in(recording.sent)[0] if not call.startswith("GET ")} == set()


def test_no_id_and_no_camera_are_said_with_what_to_do(
    recording: Proxy, served: Served, open_tab: OpenTab
) -> None:
    tab = open_tab(served)
    page = tab.page
    tab.press("Start camera")
    expect(page.get_by_label("Person’s id")).to_be_focused()
    tab.name_person("anna")
    page.evaluate(NO_CAMERA)
    tab.press("Start camera")
    tab.is_refused("No camera was found.", "switch private mode off and choose files")
    assert b"POST " not in recording.sent


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
    tab.name_person("anna")
    attempt(tab, "Verify")
    tab.is_refused("use the pack that the contract was calibrated with", "unusable_contract")
    calls, rest = requests_in(recording.sent)
    assert rest == 0
    assert {call for call in calls if not call.startswith("GET ")} == {"POST /v1/tokens"}
    page.unroute(re.compile(r"/v1/pack/[0-9a-f]{64}$"))
