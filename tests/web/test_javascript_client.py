"""The JavaScript client in Chromium: decoding, WebAssembly, the page of its README, the element."""

import base64
import io
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, expect

from api.process.opening import file_sealer, open_keyring
from api.process.preparation import recorded_of
from models.pack import FacePolicy, ModelPack
from tests.api.deployment import deploy
from tests.clients.conftest import Running, started
from tests.clients.javascript.conftest import require_client
from tests.clients.javascript.test_docs import EXAMPLE, FOR_PAGES
from tests.leaks import LeakSearch, as_bytes
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.client_page import Application, application, for_browsers
from tests.web.conftest import OTHER, WHO
from veilface_client import Client

pytestmark = pytest.mark.long

EMBEDDING = """
import * as ort from "onnxruntime-web";
import { decodeImage, ModelPack } from "veilface-client";

window.embedded = async (names, contract, graphs) => {
  const bytes = async (path) => new Uint8Array(await (await fetch(path)).arrayBuffer());
  const { detector, embedder } = graphs;
  const pack = await ModelPack.load(ort, contract, {
    detector: await bytes(detector),
    embedder: await bytes(embedder),
  });
  const samples = [];
  for (const name of names) {
    const image = await decodeImage(await (await fetch(`/photos/${name}`)).blob());
    const { crop, embedding } = await pack.embedPhoto(image, { policy: "largest" });
    samples.push({ crop: [...crop.data], embedding: [...embedding] });
  }
  return samples;
};
"""


@pytest.fixture(scope="module")
def running(
    tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path, pack: ModelPack
) -> Iterator[Running]:
    """A service with the real pack, whose thresholds are made up."""
    folder = tmp_path_factory.mktemp("javascript")
    deployment = deploy(folder, pack=mbf_pack_dir)
    deployment.allow_templates()
    settings = deployment.settings
    contract = replace(deployment.contract, recorded=recorded_of(pack))
    contract.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    with started(deployment, folder) as service:
        yield service


@pytest.fixture(scope="module")
def pack(mbf_pack_dir: Path) -> ModelPack:
    return ModelPack.load(mbf_pack_dir, threads=1)


@pytest.fixture(scope="module")
def page(running: Running, pack: ModelPack, mbf_pack_dir: Path) -> Iterator[Application]:
    """The application; its tokens are the service's key, which no real one would give away."""
    require_client()

    def authorize() -> dict[str, str]:
        return {"subject": "anna", "token": running.deployment.token}

    with application(running.url, mbf_pack_dir, pack, authorize) as served:
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
    page.sent.clear()
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
    tab.page.wait_for_function("() => window.embedded !== undefined")
    info = pack.info
    assert info.detector is not None
    contract = {
        "binding": {
            "embedder_sha256": info.embedder_sha256,
            "preprocessing": info.preprocessing,
            "n": info.n,
        },
        "recorded": recorded_of(pack),
    }
    graphs = {
        "detector": f"/v1/pack/{info.detector.sha256}",
        "embedder": f"/v1/pack/{info.embedder_sha256}",
    }
    samples: list[dict[str, Any]] = tab.page.evaluate(
        "([names, contract, graphs]) => window.embedded(names, contract, graphs)",
        [list(photos), contract, graphs],
    )
    for data, sample in zip(photos.values(), samples, strict=True):
        taken = pack.crop_photo(data, policy=FacePolicy.LARGEST)
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
    visit(tab, page, FOR_PAGES[0])
    tab.page.wait_for_function("() => document.querySelector('input').onchange !== null")
    tab.page.set_input_files("input", own)
    expect(tab.page.locator("body > output")).to_have_text("welcome")
    tab.page.set_input_files("input", other)
    expect(tab.page.locator("body > output")).to_have_text("try again")
    sent = b"\n".join(page.sent)
    assert sent.count(b'"hmac"') == 2
    data = own.read_bytes()
    embedding = pack.embed_photo(data, policy=FacePolicy.LARGEST).embedding
    search = LeakSearch(vectors={"embedding": embedding}, strings={"photo": data})
    assert search.find(sent) == []
    for planted in (as_bytes(embedding, "float32", little=True), base64.b64encode(data)):
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
    visit(tab, page, FOR_PAGES[1])
    tab.page.evaluate("document.querySelector('veilface-login').setAttribute('action', 'enroll')")
    tab.page.get_by_role("button", name="Start camera").click()
    tab.page.get_by_role("button", name="Enroll").click()
    expect(tab.page.locator("veilface-login output")).to_have_text("You are enrolled.")
    tab.page.evaluate("document.querySelector('veilface-login').removeAttribute('action')")
    for who, says in ((WHO, "Welcome."), (OTHER, "That did not match. Try again.")):
        camera.shows(people[who][0])
        tab.page.get_by_role("button", name="Start camera").click()
        tab.page.get_by_role("button", name="Log in").click()
        expect(tab.page.locator("veilface-login output")).to_have_text(says)
    camera.shows()
    tab.page.get_by_role("button", name="Start camera").click()
    tab.page.get_by_role("button", name="Log in").click()
    expect(tab.page.locator("veilface-login output")).to_contain_text("No face was found")
    assert said == ["undefined", "true", "false", "no_face"], "an enrollment is no decision"
