"""The JavaScript client in Chromium: decoding, WebAssembly, the page of its README, the element."""

import base64
import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from models.pack import ModelPack
from tests.clients.conftest import Running
from tests.clients.javascript.conftest import require_client
from tests.clients.pages import EXAMPLE, OF_THE_CLIENT, OF_THE_ELEMENT
from tests.clients.recorded import requests_in
from tests.leaks import LeakSearch, as_bytes
from tests.web.answers import refused
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.client_page import Application, application, for_browsers
from tests.web.conftest import OTHER, WHO
from tests.web.passkeys import Authenticator
from veilface_client import Client, NotEnrolled

pytestmark = pytest.mark.long

LEVEL = "fmr-1e-3"
EMBEDDING = """
import * as ort from "onnxruntime-web";
import { Client, decodeImage, ModelPack } from "veilface-client";

window.embedded = async (names) => {
  const { token } = await (await fetch("/login/token", { method: "POST" })).json();
  const client = new Client(location.origin, token);
  const pack = await ModelPack.load(ort, await client.contract(), await client.pack());
  const samples = [];
  for (const name of names) {
    const image = await decodeImage(await (await fetch(`/photos/${name}`)).blob());
    const { crop, embedding } = await pack.embedPhoto(image);
    samples.push({ crop: [...crop.data], embedding: [...embedding] });
  }
  return samples;
};
"""


@pytest.fixture(scope="module")
def page(running: Running) -> Iterator[Application]:
    """The application: anna is enrolled if she is not, and else verified."""
    require_client()
    with Client(running.url, running.deployment.token) as client:

        def authorize(_: object) -> dict[str, str]:
            try:
                client.describe("anna")
            except NotEnrolled:
                issued = client.create_token("anna", "enroll")
            else:
                issued = client.create_token("anna", "verify", level=LEVEL)
            return {"subject": "anna", "token": issued.token}

        with application(running.url, authorize) as served:
            yield served


@pytest.fixture
def tab(browser: Browser, page: Application) -> Iterator[BrowserTab]:
    context = browser.new_context()
    opened = BrowserTab.of(context, page.url + "/")
    yield opened
    try:
        assert opened.strays() == []
        assert opened.violations() == []
        assert opened.complaints == []
    finally:
        context.close()


def visit(tab: BrowserTab, page: Application, program: str) -> None:
    page.program = for_browsers(program.replace(EXAMPLE, page.url))
    page.recording.forget()
    tab.page.goto(tab.url)


def test_the_browser_sees_what_python_sees(
    tab: BrowserTab, page: Application, pack: ModelPack, people: dict[str, list[Path]]
) -> None:
    """Decoded by the browser, upright by EXIF, embedded by WebAssembly."""
    photos = {path.name: path.read_bytes() for path in (*people[WHO][:3], *people[OTHER][:2])}
    turned = Image.open(people[WHO][0]).transpose(Image.Transpose.ROTATE_90)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise by 90 degrees
    out = io.BytesIO()
    turned.save(out, "JPEG", quality=95, exif=exif)
    photos["turned.jpg"] = out.getvalue()
    page.photos = photos
    visit(tab, page, EMBEDDING)
    tab.wait_for("() => window.embedded !== undefined")
    samples: list[dict[str, Any]] = tab.page.evaluate(
        "(names) => window.embedded(names)", list(photos)
    )
    for data, sample in zip(photos.values(), samples, strict=True):
        taken = pack.crop_photo(data)
        crop = np.asarray(sample["crop"]).reshape(taken.crop.shape)
        assert np.abs(crop - taken.crop.astype(int)).mean() < 1
        embedding = np.asarray(sample["embedding"], dtype=np.float32)
        assert float(embedding @ pack.embed(taken.crop[None])[0]) >= 0.9995


def test_the_page_of_the_documentation(
    tab: BrowserTab,
    page: Application,
    running: Running,
    pack: ModelPack,
    people: dict[str, list[Path]],
) -> None:
    """The very person is let in, another is not; what was sent has no face in it."""
    own, other = people[WHO][0], people[OTHER][0]
    with Client(running.url, running.deployment.token) as client:
        client.enroll("anna", own)
    visit(tab, page, OF_THE_CLIENT)
    tab.wait_for("() => document.querySelector('input').onchange !== null")
    tab.page.set_input_files("input", own)
    expect(tab.page.locator("body > output")).to_have_text("welcome")
    tab.page.set_input_files("input", other)
    expect(tab.page.locator("body > output")).to_have_text("try again")
    sent = page.recording.sent
    assert sent.count(b'{"template":') == 2
    data = own.read_bytes()
    embedding = pack.embed_photo(data).embedding
    search = LeakSearch(vectors={"embedding": embedding}, strings={"photo": data})
    assert search.find(sent) == []
    for planted in (as_bytes(embedding, "float32"), base64.b64encode(data)):
        assert search.find(sent + planted), "it would have been found"


def test_the_element(
    tab: BrowserTab,
    page: Application,
    running: Running,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    """Camera, burst, template, decision, event: of the person, then of somebody else."""
    said: list[str] = []
    tab.page.on("console", lambda message: said.append(message.text))
    camera.shows(people[WHO][0])
    with Client(running.url, running.deployment.token) as client, contextlib.suppress(NotEnrolled):
        client.erase("anna")
    visit(tab, page, OF_THE_ELEMENT)
    login = tab.page.locator("veilface-login")
    login.evaluate("(each) => each.setAttribute('action', 'enroll')")
    tab.page.get_by_role("button", name="Start camera").click()
    tab.page.get_by_role("button", name="Enroll").click()
    expect(tab.page.locator("veilface-login output")).to_have_text("You are enrolled.")
    calls, _ = requests_in(page.recording.sent)
    assert calls["PUT /v1/subjects/*/enrollment"]["members"] == ["template"]
    login.evaluate("(each) => each.removeAttribute('action')")
    for who, says in ((WHO, "Welcome."), (OTHER, "Not recognised. Try again.")):
        camera.shows(people[who][0])
        tab.page.get_by_role("button", name="Start camera").click()
        tab.page.get_by_role("button", name="Log in").click()
        expect(tab.page.locator("veilface-login output")).to_have_text(says)
        login.evaluate("(each) => each.reset()")
    locked = refused(423, "locked_out", "too many failed attempts", wait=30)
    locked["headers"]["Access-Control-Allow-Origin"] = "*"
    tab.page.route("**/verify", lambda route: route.fulfill(**locked))
    tab.page.get_by_role("button", name="Start camera").click()
    tab.page.get_by_role("button", name="Log in").click()
    output = tab.page.locator("veilface-login output")
    expect(output).to_contain_text("An administrator can lift the lock.")
    login.evaluate("(each) => each.reset()")
    camera.shows()
    tab.page.get_by_role("button", name="Start camera").click()
    # The guidance says the same as the error.
    with tab.page.expect_console_message(lambda message: message.text == "no_face"):
        tab.page.get_by_role("button", name="Log in").click()
    expect(output).to_contain_text("Bring your face into the outline.")
    told = [text for text in said if not text.startswith("Failed to load")]
    assert told == ["undefined", "true", "false", "locked_out", "no_face"], "no decision at first"


def test_the_element_locks_an_enrollment_to_a_passkey(
    browser: Browser,
    page: Application,
    running: Running,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    """As the service's page does, by the key that the documentation derives; nothing without it."""
    own = people[WHO][0]
    camera.shows(own)
    with Client(running.url, running.deployment.token) as client, contextlib.suppress(NotEnrolled):
        client.erase("anna")
    context = browser.new_context()
    try:
        # Under a name: an IP address has no passkeys.
        tab = BrowserTab.of(context, page.url.replace("127.0.0.1", "localhost") + "/")
        authenticator = Authenticator.of(tab.page)
        says = tab.page.locator("veilface-login output")
        page.program = for_browsers(OF_THE_ELEMENT.replace(f'"{EXAMPLE}"', "location.origin"))
        tab.page.goto(tab.url)
        login = "document.querySelector('veilface-login')"
        tab.page.evaluate(f"{login}.setAttribute('passkey', '')")
        tab.page.evaluate(f"{login}.setAttribute('action', 'enroll')")
        tab.page.get_by_role("button", name="Start camera").click()
        # The photos are taken before a passkey is asked for; the visitor says no, and then yes.
        authenticator.refuse()
        tab.page.get_by_role("button", name="Enroll").click()
        expect(says).to_contain_text("No passkey was used")
        authenticator.exchange()
        tab.page.get_by_role("button", name="Enroll").click()
        expect(says).to_have_text("You are enrolled.")
        assert authenticator.passkeys() == 1

        tab.page.evaluate(f"{login}.removeAttribute('action')")
        tab.page.get_by_role("button", name="Start camera").click()
        tab.page.get_by_role("button", name="Log in").click()
        expect(says).to_have_text("Welcome.")
        expect(tab.page.locator("veilface-login button")).to_be_hidden()
        tab.page.evaluate(f"{login}.reset()")

        key = authenticator.holder_key("anna")
        with Client(running.url, running.deployment.token) as client:
            assert client.describe("anna").holder_key
            assert client.verify("anna", own, level=LEVEL, holder_key=decoded(key))
            assert not client.verify("anna", own, level=LEVEL)
        assert key.encode() in page.recording.sent, "the one that was sent is the documented one"

        assert tab.complaints == []
    finally:
        context.close()


def decoded(key: str) -> bytes:
    return base64.urlsafe_b64decode(key + "=")
