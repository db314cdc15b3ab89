"""Take a picture of every view of the page in every state, for a person to look at.

Serves the demo and, where the real models and faces are present, a real pack; walks through the
page in Chromium at two sizes, light and dark, and writes a PNG for each state.

Example
-------
::

    python -m tests.web.screenshots OUT
    python -m tests.web.screenshots OUT --only verify
    python -m tests.web.screenshots docs --docs
"""

import argparse
import io
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser

from tests.conftest import DEFAULT_SHARED_DATA
from tests.web import walk
from tests.web.access import SIZES, looks
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import installed_browser, running_browser
from tests.web.deployments import OTHER, WHO, demo_service, moving_service, real_service
from tests.web.served import Served

Walk = Callable[[BrowserTab, Served], Iterator[str]]

SHOWN_IN_DOCS = "verify-accepted"
COLOURS = 256


@dataclass(frozen=True)
class Pictures:
    """Where pictures go, and which are taken."""

    out: Path
    only: str = ""
    docs: bool = False

    def take(self, browser: Browser, walk: Walk, served: Served) -> None:
        """Walk, and take a picture of the states that are meant at each size, light and dark."""
        width, height = SIZES[0]
        context = browser.new_context(viewport={"width": width, "height": height})
        # Passkeys belong to a name.
        tab = BrowserTab.of(context, served.url.replace("127.0.0.1", "localhost") + "/")
        for name in walk(tab, served):
            if self.docs and name == SHOWN_IN_DOCS:
                self._take_for_docs(tab)
                break
            if name.startswith(self.only) and not self.docs:
                for look in looks(tab.page):
                    folder = self.out / look
                    folder.mkdir(parents=True, exist_ok=True)
                    (folder / f"{name}.png").write_bytes(picture_of(tab))
        context.close()

    def _take_for_docs(self, tab: BrowserTab) -> None:
        next(looks(tab.page))
        taken = Image.open(io.BytesIO(picture_of(tab))).convert("RGB")
        # In few colours, so that it is small.
        taken.quantize(COLOURS).save(self.out / "web-page.png", optimize=True)


def picture_of(tab: BrowserTab) -> bytes:
    """The whole page, as a PNG."""
    tab.page.evaluate("scrollTo(0, 0)")
    return tab.page.screenshot(full_page=True)


def main() -> None:
    """Serve, walk and take the pictures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT")
    parser.add_argument("--only", default="", metavar="NAME", help="states that begin so")
    parser.add_argument("--docs", action="store_true", help="the picture of the documentation")
    pictures = Pictures(**vars(parser.parse_args()))
    data = Path(os.environ.get("VEILFACE_TEST_DATA", DEFAULT_SHARED_DATA))
    executable = installed_browser()
    if executable is None:
        raise SystemExit("no browser is installed: name one in VEILFACE_TEST_BROWSER")
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        work = Path(folder)
        camera = FakeCamera(work / "camera.mjpeg")
        browser = stack.enter_context(running_browser(Path(executable), *camera.flags))
        demo = stack.enter_context(demo_service(work / "demo"))
        if pictures.docs:
            pictures.take(browser, walk.walk_verify, demo)
            return
        for each in (*walk.DEMO_WALKS, walk.walk_passkeys):
            pictures.take(browser, each, demo)
        pictures.take(
            browser,
            walk.walk_challenge,
            stack.enter_context(moving_service(work / "moving")),
        )
        if data.exists():
            lfw, pack = data / "lfw", data / "packs" / "w600k_mbf"
            real = stack.enter_context(real_service(work / "real", pack, lfw / "aligned112"))
            own, other = (sorted((lfw / "photos" / name).glob("*.jpg")) for name in (WHO, OTHER))
            faces = partial(walk.walk_real, camera=camera, own=own, other=other)
            pictures.take(browser, faces, real)


if __name__ == "__main__":
    main()
