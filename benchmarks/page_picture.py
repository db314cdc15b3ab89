"""Run the demo, verify a cartoon person on its page, and take the README's picture of it.

Needs Chromium; ``VEILFACE_TEST_BROWSER`` names another one.

Example
-------
::

    python -m benchmarks.page_picture docs/web-page.png
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import FloatRect, Page, expect, sync_playwright

from benchmarks.deployment import service, veilface

WHO = "person-2"
SHOT = 3
WIDTH, HEIGHT = 1000, 1800
"""Of the window: high enough for the whole page, so that nothing is scrolled."""
MARGIN = 20
COLOURS = 256


def main() -> None:
    """Take the picture, in few colours, so that it is small."""
    expect.set_options(timeout=60_000)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        demo = work / "demo-data"
        env = {k: v for k, v in os.environ.items() if not k.startswith("VEILFACE_")}
        veilface("demo", "--folder", demo, env=env)
        env["VEILFACE_CONFIG"] = str(demo / "veilface.toml")
        token = (demo / "api-key").read_text().strip()
        with service(env, workers=1, log=work / "log") as url, sync_playwright() as playwright:
            browser = playwright.chromium.launch(
                executable_path=os.environ.get("VEILFACE_TEST_BROWSER") or shutil.which("chromium"),
                args=["--no-sandbox"],
            )
            page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
            # Passkeys belong to a name.
            verify(page, url.replace("127.0.0.1", "localhost"), token)
            page.screenshot(path=work / "page.png", clip=from_photos_to_verdict(page))
            browser.close()
        with Image.open(work / "page.png") as taken:
            taken.convert("RGB").quantize(COLOURS).save(sys.argv[1], optimize=True)


def verify(page: Page, url: str, token: str) -> None:
    """Sign in, choose a photo of an enrolled cartoon person, and have it accepted."""
    page.goto(url)
    page.get_by_label("API key").fill(token)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("navigation", name="Views").get_by_role("link", name="Verify").click()
    page.get_by_label("Person's id").fill(WHO)
    page.get_by_label("Cartoon person").select_option(WHO)
    page.get_by_role("button", name=f"Choose photo {SHOT} of {WHO}", exact=True).click()
    expect(page.locator(".tray .seen[data-state=good]")).to_be_visible()
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.accept")).to_be_visible()


def from_photos_to_verdict(page: Page) -> FloatRect:
    """The part of the page that shows cartoon people, the photo that was chosen, and the answer."""
    top = page.get_by_text("1 to 5 photos of one person").bounding_box()
    end = page.locator(".verdict").bounding_box()
    assert top is not None
    assert end is not None
    height = end["y"] + end["height"] - top["y"] + 2 * MARGIN
    width = 2 * end["x"] + end["width"]
    return {"x": 0, "y": top["y"] - MARGIN, "width": width, "height": height}


if __name__ == "__main__":
    main()
