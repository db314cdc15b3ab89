"""Enrollments that are locked to a key of their holder's, from a passkey."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.clients.javascript.conftest import require_client
from tests.web.browser_tab import BrowserTab
from tests.web.conftest import OpenTab
from tests.web.passkeys import Authenticator
from tests.web.served import Served

pytestmark = pytest.mark.long

SUBJECT, PERSON = "locked-person", "person-2"


@pytest.fixture(autouse=True)
def subject(demo: Served) -> Iterator[str]:
    """Erase whom a test enrolled, and the lock that its rejections may have left."""
    yield SUBJECT
    with demo.client() as client:
        # A test may enroll nobody, and be the first one here.
        assert client.delete(f"/v1/subjects/{SUBJECT}").status_code in (200, 404)


@dataclass
class Visitor:
    """A signed-in tab, its authenticator, and everything that its console was told."""

    tab: BrowserTab
    authenticator: Authenticator
    console: list[str]

    def enroll(self) -> None:
        """Enroll the drawn person, locked to a passkey."""
        self.tab.open("Enroll")
        self.tab.name_person(SUBJECT)
        for shot in (1, 2, 3):
            self.tab.choose_drawn(PERSON, shot)
        self.tab.lock()
        self.tab.press("Enroll")

    def verify(self, subject: str = SUBJECT) -> None:
        """Show another photo of the same person; the page knows of the lock."""
        self.tab.open("Verify")
        self.tab.name_person(subject)
        self.tab.choose_drawn(PERSON, 4)
        self.tab.press("Verify")

    def sent(self, path: str) -> int:
        return sum(url.endswith(path) for url in self.tab.requests)


@pytest.fixture
def visit(open_tab: OpenTab, local: Served) -> Callable[..., Visitor]:
    require_client()

    def sign_in(token: str = "", **options: object) -> Visitor:
        tab = open_tab(local, sign_in=token, **options)
        console: list[str] = []
        tab.page.on("console", lambda message: console.append(message.text))
        return Visitor(tab, Authenticator.of(tab.page), console)

    return sign_in


Visit = Callable[..., Visitor]


def test_a_face_is_accepted_with_the_passkey_that_it_was_enrolled_with(
    visit: Visit, local: Served
) -> None:
    visitor = visit()
    tab, page = visitor.tab, visitor.tab.page
    visitor.enroll()
    expect(page.locator(".verdict")).to_contain_text("Holder keyneeded at every verification")
    page.get_by_role("link", name="Verify this person").click()
    expect(page.get_by_label("Use the passkey")).to_be_checked()
    expect(page.get_by_text("This enrollment is locked to a holder key.")).to_be_visible()
    tab.choose_drawn(PERSON, 4)
    tab.press("Verify")
    tab.is_decided("accept")

    # Without the key, the face is not enough.
    tab.lock(False)
    expect(page.locator(".verdict")).to_have_count(0)
    tab.press("Verify")
    tab.is_decided("reject")
    expect(page.locator(".verdict")).to_contain_text("a holder key that is wrong or missing")
    tab.open("People")
    person = page.locator("li.person").filter(has_text=SUBJECT)
    expect(person).to_contain_text("locked to a holder key")
    assert visitor.authenticator.passkeys() == 1

    # As documented, the key comes from the passkey and the id alone.
    key = visitor.authenticator.holder_key(SUBJECT)
    photo = local.settings.data_dir / "people" / PERSON / "4.png"
    with local.client() as client:
        answer = client.post(
            f"/v1/subjects/{SUBJECT}/verify",
            files={"image": ("4.png", photo.read_bytes())},
            data={"holder_key": key},
        ).json()
    assert answer["decision"] == "accept"
    assert_kept_nowhere(visitor, key, local.log)

    # A key that may only verify is not told who is locked.
    verifying = visit(local.key("verify"))
    verifying.verify()
    verifying.tab.is_decided("reject")
    expect(verifying.tab.page.get_by_text("locked to a holder key")).to_have_count(0)
    assert verifying.sent(f"/v1/subjects/{SUBJECT}") == 0


def assert_kept_nowhere(visitor: Visitor, key: str, log: Path) -> None:
    page = visitor.tab.page
    assert page.evaluate("sessionStorage.length + localStorage.length") == 0
    assert page.evaluate("document.cookie") == ""
    assert page.evaluate("indexedDB.databases().then((all) => all.length)") == 0
    places = [page.content(), page.url, log.read_text(), *visitor.tab.requests, *visitor.console]
    assert not any(key in place for place in places)
    typed = page.locator("input").evaluate_all("all => all.map((input) => input.value)")
    assert key not in typed


def test_another_authenticator_opens_nothing(visit: Visit) -> None:
    visitor = visit()
    tab, page = visitor.tab, visitor.tab.page
    visitor.enroll()
    tab.is_decided("accept")
    visitor.authenticator.exchange()
    visitor.verify()
    tab.is_refused("passkey_refused", "No passkey was used")
    assert visitor.sent("/verify") == 0

    # A passkey of the same name: made for an enrollment that did not come about.
    page.route("**/enrollment", lambda route: route.abort())
    visitor.enroll()
    tab.is_refused("unreachable", "The service does not respond.")
    page.unroute("**/enrollment")
    tab.complaints.remove("Failed to load resource: net::ERR_FAILED")
    assert visitor.authenticator.passkeys() == 1
    visitor.verify()
    tab.is_decided("reject")
    assert visitor.sent("/verify") == 1


def test_a_passkey_of_another_id_is_not_sent(visit: Visit) -> None:
    visitor = visit()
    visitor.enroll()
    visitor.tab.is_decided("accept")
    tab = visitor.tab
    tab.open("Verify")
    tab.name_person("person-2")
    expect(tab.page.get_by_text("✓ Enrolled")).to_be_visible()
    tab.choose_drawn(PERSON, 4)
    tab.lock()
    tab.press("Verify")
    visitor.tab.is_refused("passkey_of_another", "This passkey is not for person-2.")
    assert visitor.sent("/verify") == 0


def test_a_passkey_is_of_an_id_however_it_is_spelt(visit: Visit) -> None:
    page = visit().tab.page
    keys = page.evaluate(
        """async () => {
          const { createPasskey, passkeyHolderKey } = await import("/assets/client/client.js");
          const { signal } = new AbortController();
          const made = await createPasskey("fo\u0308und", signal);
          const keys = [];
          for (const id of ["fo\u0308und", "f\u00f6und"]) {
            keys.push(String(await passkeyHolderKey(id, signal, made)));
          }
          return keys;
        }"""
    )
    assert len(set(keys)) == 1


def test_an_ip_address_has_no_passkeys(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.open("Enroll")
    tab.page.get_by_text("Options:").click()
    expect(tab.page.get_by_label("Lock to a passkey")).to_be_disabled()
    expect(tab.page.get_by_text("Passkeys belong to a host name")).to_be_visible()
