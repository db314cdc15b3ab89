"""Enrollments that are locked to a key of their holder's: from a passkey, or from a file."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.clients.javascript.conftest import require_client
from tests.web.access import assert_accessible
from tests.web.browser_tab import BrowserTab
from tests.web.conftest import OpenTab
from tests.web.passkeys import Authenticator
from tests.web.served import Served
from tests.web.walk import choose
from tests.web.walk_obstacles import TO_FILE, TO_PASSKEY

pytestmark = pytest.mark.long

SUBJECT, PERSON = "locked-person", "person-2"


@pytest.fixture(autouse=True)
def subject(demo: Served) -> Iterator[str]:
    """Erase whom a test enrolled, and the lock that its rejections may have left."""
    yield SUBJECT
    with demo.client() as client:
        assert client.delete(f"/v1/subjects/{SUBJECT}").is_success


@dataclass
class Visitor:
    """A signed-in tab, its authenticator, and everything that its console was told."""

    tab: BrowserTab
    authenticator: Authenticator
    console: list[str]

    def enroll(self, lock: str) -> None:
        """Enroll the drawn person, locked in this way."""
        page = self.tab.page
        self.tab.open("Enroll")
        page.get_by_label("Person's id").fill(SUBJECT)
        for shot in (1, 2, 3):
            choose(self.tab, PERSON, shot)
        page.get_by_label(lock).check()
        page.get_by_role("button", name="Enroll", exact=True).click()

    def verify(self, lock: str | None = None) -> None:
        """Show another photo of the same person; choose the lock, or let the page do it."""
        page = self.tab.page
        self.tab.open("Verify")
        page.get_by_label("Person's id").fill(SUBJECT)
        choose(self.tab, PERSON, 4)
        if lock:
            page.get_by_label(lock, exact=True).check()
        self.send()

    def send(self) -> None:
        """Verify what is chosen."""
        self.tab.page.get_by_role("button", name="Verify", exact=True).click()

    def is_told(self, decision: str) -> None:
        expect(self.tab.page.locator(f".verdict.{decision}")).to_be_visible()

    def is_refused(self, code: str, words: str) -> None:
        """The page itself says no, and why."""
        alert = self.tab.page.get_by_role("alert")
        expect(alert).to_contain_text(words)
        expect(alert).to_contain_text(code)

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
    page = visitor.tab.page
    visitor.enroll(TO_PASSKEY)
    expect(page.locator(".verdict")).to_contain_text("Holder keyneeded at every verification")
    page.get_by_role("link", name="Verify this person").click()
    expect(page.get_by_label("Passkey", exact=True)).to_be_checked()
    expect(page.get_by_text("This enrollment is locked to a holder key.")).to_be_visible()
    choose(visitor.tab, PERSON, 4)
    visitor.send()
    visitor.is_told("accept")

    # Without the key, the face is not enough.
    page.get_by_label("None", exact=True).check()
    expect(page.locator(".verdict")).to_have_count(0)
    visitor.send()
    visitor.is_told("reject")
    expect(page.locator(".verdict")).to_contain_text("a holder key that is wrong or missing")
    visitor.tab.open("People")
    expect(page.locator("li.person").filter(has_text=SUBJECT)).to_contain_text(
        "locked to a holder key"
    )
    assert visitor.authenticator.passkeys() == 1

    # As documented, the key comes from the passkey and the id alone.
    key = visitor.authenticator.holder_key(SUBJECT)
    photo = local.settings.data_dir / "people" / PERSON / "4.png"
    with local.client() as client:
        probe = {"image": ("4.png", photo.read_bytes())}
        told = client.post(
            f"/v1/subjects/{SUBJECT}/verify", files=probe, data={"holder_key": key}
        ).json()
    assert told["decision"] == "accept"
    assert_kept_nowhere(visitor, key, local.log)


def assert_kept_nowhere(visitor: Visitor, key: str, log: Path) -> None:
    page = visitor.tab.page
    assert page.evaluate("sessionStorage.length + localStorage.length") == 0
    assert page.evaluate("document.cookie") == ""
    assert page.evaluate("indexedDB.databases().then((all) => all.length)") == 0
    places = [page.content(), page.url, log.read_text(), *visitor.tab.requests, *visitor.console]
    assert not any(key in place for place in places)
    typed = page.locator("input").evaluate_all("all => all.map((input) => input.value)")
    assert key not in typed


def test_another_authenticator_opens_nothing(visit: Visit, local: Served) -> None:
    visitor = visit()
    page = visitor.tab.page
    visitor.enroll(TO_PASSKEY)
    visitor.is_told("accept")

    visitor.authenticator.exchange()
    visitor.verify()
    visitor.is_refused("passkey_refused", "No passkey was used")
    assert visitor.sent("/verify") == 0

    # A passkey of the same name: made for an enrollment that did not come about.
    page.route("**/enrollment", lambda route: route.abort())
    visitor.enroll(TO_PASSKEY)
    visitor.is_refused("unreachable", "The service does not respond.")
    page.unroute("**/enrollment")
    visitor.tab.complaints.remove("Failed to load resource: net::ERR_FAILED")
    assert visitor.authenticator.passkeys() == 1
    visitor.verify()
    visitor.is_told("reject")
    assert visitor.sent("/verify") == 1


def test_an_attempt_that_failed_leaves_one_passkey(visit: Visit) -> None:
    visitor = visit()
    page = visitor.tab.page
    page.route("**/enrollment", lambda route: route.abort())
    visitor.enroll(TO_PASSKEY)
    visitor.is_refused("unreachable", "The service does not respond.")
    page.unroute("**/enrollment")
    visitor.tab.complaints.remove("Failed to load resource: net::ERR_FAILED")
    page.get_by_role("button", name="Enroll", exact=True).click()
    visitor.is_told("accept")
    assert visitor.authenticator.passkeys() == 1


def test_a_passkey_of_another_id_is_not_sent(visit: Visit) -> None:
    visitor = visit()
    page = visitor.tab.page
    visitor.enroll(TO_PASSKEY)
    visitor.is_told("accept")
    visitor.tab.open("Verify")
    page.get_by_label("Person's id").fill("person-2")
    choose(visitor.tab, PERSON, 4)
    page.get_by_label("Passkey", exact=True).check()
    visitor.send()
    visitor.is_refused("passkey_of_another", "This passkey is not for person-2.")
    assert visitor.sent("/verify") == 0


def test_what_keeps_a_passkey_from_being_used_is_said(visit: Visit, local: Served) -> None:
    visitor = visit()
    visitor.authenticator.exchange(prf=False)
    visitor.enroll(TO_PASSKEY)
    visitor.is_refused("passkey_unsupported", "no PRF extension")
    again = visitor.tab.page.get_by_role("button", name="Enroll", exact=True)
    visitor.authenticator.exchange()
    visitor.authenticator.refuse()
    again.click()
    visitor.is_refused("passkey_refused", "cancelled, timed out")
    assert visitor.sent("/enrollment") == 0
    visitor.authenticator.exchange()
    again.click()
    visitor.is_told("accept")
    visitor.authenticator.refuse()
    visitor.verify()
    visitor.is_refused("passkey_refused", "If it is lost, enroll the person again.")
    assert visitor.sent("/verify") == 0


def test_a_key_that_may_only_verify_is_not_told_who_is_locked(visit: Visit, local: Served) -> None:
    enrolling = visit()
    enrolling.enroll(TO_PASSKEY)
    enrolling.is_told("accept")
    verifying = visit(local.key("verify"))
    page = verifying.tab.page
    verifying.verify()
    verifying.is_told("reject")
    expect(page.get_by_label("None", exact=True)).to_be_checked()
    expect(page.get_by_text("locked to a holder key")).to_have_count(0)
    assert verifying.sent(f"/v1/subjects/{SUBJECT}") == 0


def test_an_ip_address_has_no_passkeys_but_key_files(
    open_tab: OpenTab, demo: Served, tmp_path: Path
) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Enroll")
    expect(page.get_by_label(TO_PASSKEY)).to_be_disabled()
    expect(page.get_by_text("Passkeys belong to a host name")).to_be_visible()
    assert_accessible(tab, "enroll-no-passkeys")
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(tab, PERSON, 1)
    page.get_by_label(TO_FILE).check()
    page.get_by_label("Key file", exact=True).set_input_files(made_key_file(tab, tmp_path))
    page.get_by_role("button", name="Enroll", exact=True).click()
    expect(page.locator(".verdict.accept")).to_be_visible()
    tab.open("Verify")
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(tab, PERSON, 4)
    expect(page.get_by_label("Key file").first).to_be_checked()


def made_key_file(tab: BrowserTab, folder: Path) -> Path:
    """Let the page make a key file; return where it was saved."""
    with tab.page.expect_download() as download:
        tab.page.get_by_role("button", name="Make a key file").click()
    assert download.value.suggested_filename == f"{SUBJECT}.holder-key.txt"
    saved = folder / f"{len(list(folder.iterdir()))}.txt"
    download.value.save_as(saved)
    return saved


def test_a_face_is_accepted_with_the_key_file_that_it_was_enrolled_with(
    visit: Visit, local: Served, tmp_path: Path
) -> None:
    visitor = visit()
    page = visitor.tab.page
    visitor.enroll(TO_FILE)
    # The browser asks for the file.
    assert visitor.sent("/enrollment") == 0
    own, other = (made_key_file(visitor.tab, tmp_path) for _ in range(2))
    assert own.read_text() != other.read_text()
    nonsense = tmp_path / "nonsense.txt"
    nonsense.write_text("not a key")
    file = page.get_by_label("Key file", exact=True)
    file.set_input_files(own)
    page.get_by_role("button", name="Enroll", exact=True).click()
    visitor.is_told("accept")
    visitor.tab.open("Verify")
    page.get_by_label("Person's id").fill(SUBJECT)
    choose(visitor.tab, PERSON, 4)
    page.get_by_role("radio", name="Key file").check()
    file = page.locator("input[type=file][required]")
    for chosen, decision in ((other, "reject"), (own, "accept")):
        file.set_input_files(chosen)
        visitor.send()
        visitor.is_told(decision)
        # It is dropped with the answer.
        assert file.evaluate("(input) => input.files.length") == 0
    file.set_input_files(nonsense)
    visitor.send()
    visitor.is_refused("key_file", "That is no key file.")
    assert visitor.sent("/verify") == 2
    assert_kept_nowhere(visitor, own.read_text().strip(), local.log)
