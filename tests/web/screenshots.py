"""Take a picture of every view of the page in every state, for a person to look at.

Serves the demo and, where the real models and faces are present, a real pack; walks through the
page in Chromium at two sizes, light and dark, and writes a PNG for each state. A name limits it to
the states that begin so.

Example
-------
::

    python -m tests.web.screenshots OUT [NAME]
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal

from playwright.sync_api import Browser, expect, sync_playwright

from tests.conftest import DEFAULT_SHARED_DATA
from tests.patience import PATIENCE_S
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.deployments import OTHER, WHO, demo_service, real_service
from tests.web.served import Served
from tests.web.walk import walk_demo, walk_real

SIZES = ((1280, 800), (390, 844))
SCHEMES: tuple[Literal["light", "dark"], ...] = ("light", "dark")


Walk = Callable[[BrowserTab, Served], Iterator[str]]


def main() -> None:
    """Serve, walk and take the pictures."""
    out, prefix = Path(sys.argv[1]), "".join(sys.argv[2:])
    data = Path(os.environ.get("VEILFACE_TEST_DATA", DEFAULT_SHARED_DATA))
    expect.set_options(timeout=1000 * PATIENCE_S)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        work = Path(folder)
        camera = FakeCamera(work / "camera.mjpeg")
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=os.environ.get("VEILFACE_TEST_BROWSER") or shutil.which("chromium"),
            args=["--no-sandbox", *camera.flags],
        )
        demo = stack.enter_context(demo_service(work / "demo"))
        take_pictures(browser, walk_demo, demo, out, prefix)
        if data.exists():
            lfw = data / "lfw"
            pack, folder = data / "packs" / "w600k_mbf", work / "real"
            real = stack.enter_context(real_service(folder, pack, lfw / "aligned112"))
            faces = [sorted((lfw / "photos" / name).glob("*.jpg")) for name in (WHO, OTHER)]
            walk = partial(walk_real, camera=camera, own=faces[0], other=faces[1])
            take_pictures(browser, walk, real, out, prefix)


def take_pictures(browser: Browser, walk: Walk, served: Served, out: Path, prefix: str) -> None:
    """Take a picture of every state of a walk whose name begins so, in each size and scheme."""
    for (width, height), scheme in product(SIZES, SCHEMES):
        folder = out / f"{width}-{scheme}"
        folder.mkdir(parents=True, exist_ok=True)
        context = browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme=scheme,
            reduced_motion="reduce",
        )
        # Passkeys belong to a name.
        url = served.url.replace("127.0.0.1", "localhost")
        tab = BrowserTab.of(context, f"{url}/")
        for number, name in enumerate(walk(tab, served), start=1):
            if name.startswith(prefix):
                tab.page.evaluate("scrollTo(0, 0)")
                tab.page.screenshot(path=folder / f"{number:02}-{name}.png", full_page=True)
        context.close()


if __name__ == "__main__":
    main()
