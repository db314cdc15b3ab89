"""Take a picture of every view of the page in every state, for a person to look at.

Serves the demo, walks through the page in Chromium at two sizes, light and dark, and writes a PNG
for each state. ``docs/web-page.png`` is the state ``verify-accepted`` of the larger size in light.

Example
-------
::

    python -m tests.web.screenshots OUT
"""

import sys
import tempfile
from pathlib import Path

from tests.web import walk
from tests.web.access import SIZES, looks
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import installed_browser, running_browser
from tests.web.deployments import demo_service


def main(out: Path) -> None:
    """Serve, walk and take the pictures."""
    executable = installed_browser()
    if executable is None:
        raise SystemExit("no browser is installed: name one in VEILFACE_TEST_BROWSER")
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        camera = FakeCamera(work / "camera.mjpeg")
        with (
            running_browser(Path(executable), *camera.flags) as browser,
            demo_service(work / "demo") as demo,
        ):
            for each in (*walk.DEMO_WALKS, walk.walk_passkeys):
                width, height = SIZES[0]
                context = browser.new_context(viewport={"width": width, "height": height})
                # Passkeys belong to a name.
                tab = BrowserTab.of(context, demo.url.replace("127.0.0.1", "localhost") + "/")
                for state in each(tab, demo):
                    for look in looks(tab.page):
                        picture = out / look / f"{state}.png"
                        picture.parent.mkdir(parents=True, exist_ok=True)
                        tab.page.evaluate("scrollTo(0, 0)")
                        tab.page.screenshot(full_page=True, path=picture)
                context.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
