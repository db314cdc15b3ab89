"""A browser tab, and a record of it: what the browser asked for, and what it complained of."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from playwright.sync_api import BrowserContext, FilePayload, Page, expect

from tests.patience import wait_until

# A refusal of the service is an answer that the page shows; the browser notes it all the same.
REFUSED = "Failed to load resource: the server responded with a status of 4"
LISTEN = """
window.violations = [];
addEventListener("securitypolicyviolation", (e) =>
  window.violations.push(`${e.violatedDirective} ${e.blockedURI}`));
"""


@dataclass
class BrowserTab:
    """One tab, and a record of it."""

    page: Page
    url: str
    requests: list[str] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, context: BrowserContext, url: str) -> "BrowserTab":
        """Open a tab and record it from its first request on."""
        tab = cls(context.new_page(), url)
        tab.page.add_init_script(LISTEN)
        context.on("request", lambda each: tab.requests.append(each.url))
        tab.page.on("pageerror", lambda each: tab.complaints.append(str(each)))
        tab.page.on("console", tab._noted)
        return tab

    def _noted(self, message: Any) -> None:
        if message.type in ("error", "warning") and not message.text.startswith(REFUSED):
            self.complaints.append(message.text)

    def wait_for(self, expression: str, arg: Any = None) -> None:
        """Wait until an expression of the page holds.

        Playwright's own ``wait_for_function`` evaluates strings inside the page, which the content
        security policy refuses wherever the expression does not hold at once.
        """
        wait_until(lambda: self.page.evaluate(expression, arg), what=expression)

    def strays(self) -> list[str]:
        """Requests that left the page's origin."""
        here = urlsplit(self.url).netloc
        return [
            url
            for url in self.requests
            if urlsplit(url).scheme not in ("blob", "data") and urlsplit(url).netloc != here
        ]

    def violations(self) -> list[str]:
        """What the content security policy stopped."""
        found: list[str] = self.page.evaluate("window.violations")
        return found

    def assert_clean(self) -> None:
        """Nothing left the origin, and the browser had nothing to complain of."""
        strays, violations = self.strays(), self.violations()
        assert not strays, strays
        assert not violations, violations
        assert not self.complaints, self.complaints
        assert any(url.endswith("/assets/main.js") for url in self.requests)

    def sign_in(self, token: str, *, keep: bool = False) -> None:
        """Sign in with a key, which a reload of the tab forgets unless it is to be kept."""
        answer = self.page.goto(self.url)
        assert answer is not None
        assert answer.status == 200, answer.text()
        self.page.get_by_label("API key").fill(token)
        kept = self.page.get_by_label("Keep me signed in until I close this tab")
        kept.set_checked(keep)
        self.page.get_by_role("button", name="Sign in").click()
        expect(self.page.get_by_role("navigation", name="Views")).to_be_visible()

    def open(self, view: str) -> None:
        """Follow a link of the navigation."""
        self.page.get_by_role("navigation", name="Views").get_by_role("link", name=view).click()
        expect(self.page.get_by_role("heading", level=1)).to_be_focused()

    def press(self, name: str) -> None:
        """Press the button of this very name."""
        self.page.get_by_role("button", name=name, exact=True).click()

    def name_person(self, subject: str) -> None:
        """Type a person's id."""
        self.page.get_by_label("Person’s id").fill(subject)

    def start_camera(self) -> None:
        """Take photos from the camera, and start it."""
        self.page.get_by_label("Camera", exact=True).check()
        self.press("Start camera")
        expect(self.page.locator("video:visible")).to_have_count(1)

    def choose_files(self, *photos: Path | FilePayload) -> None:
        """Choose files, whatever will be said of them."""
        self.page.get_by_label("Files", exact=True).check()
        self.page.get_by_label("Choose photos").set_input_files(list(photos))  # type: ignore[arg-type]

    def choose_drawn(self, person: str, shot: int) -> None:
        """Take one photo of a drawn person, which will do."""
        self.page.get_by_label("Cartoon people", exact=True).check()
        self.page.get_by_label("Cartoon person").select_option(person)
        self.press(f"Choose photo {shot} of {person}")
        self.good(None)

    def lock(self, on: bool = True) -> None:
        """Switch the passkey on or off, among the options."""
        details = self.page.locator("details").first
        if not details.evaluate("(each) => each.open"):
            details.locator("summary").click()
        details.get_by_role("checkbox").first.set_checked(on)

    def good(self, count: int | None) -> None:
        """Wait until this many chosen photos will do, or the last one."""
        good = self.page.locator(".tray .seen[data-state=good]")
        if count is None:
            expect(self.page.locator(".tray .seen").last).to_have_attribute("data-state", "good")
        else:
            expect(good).to_have_count(count)

    def is_decided(self, decision: str) -> None:
        """Wait for the decision ``accept`` or ``reject``."""
        expect(self.page.locator(f".verdict.{decision}")).to_be_visible()

    def is_refused(self, *words: str) -> None:
        """Wait for a problem that says all of this."""
        for each in words:
            expect(self.page.get_by_role("alert")).to_contain_text(each)

    def guided(self, text: str) -> None:
        """Wait for the live guidance to say this."""
        expect(self.page.locator(".guidance")).to_contain_text(text)
