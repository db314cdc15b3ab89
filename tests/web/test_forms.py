"""Forms: whom they are about, photos that are dropped, and what comes late."""

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.api.cli.conftest import run
from tests.web.answers import refused
from tests.web.conftest import OpenTab
from tests.web.served import Served
from tests.web.walk import enroll

pytestmark = pytest.mark.long

NAMES = ("found-ada", "found-ben", "found-ben-2")
DECOMPOSED = "fo\u0308und"


def test_the_field_says_who_is_enrolled_under_an_id(open_tab: OpenTab, demo: Served) -> None:
    enroll(demo, "found-ben", "person-2")
    # As the service does, the page reads an id in Unicode's form NFC.
    enroll(demo, DECOMPOSED, "person-2")
    tab = open_tab(demo)
    page = tab.page
    enrolled = page.get_by_text("✓ Enrolled: 1 photo")
    for name in ("found-ben", DECOMPOSED):
        tab.name_person(name)
        expect(enrolled).to_be_visible()
        tab.name_person(name[:-1])
        expect(page.get_by_text("Nobody is enrolled under this id.")).to_be_visible()
    with demo.client() as client:
        for name in ("found-ben", DECOMPOSED):
            assert client.delete(f"/v1/subjects/{name}").is_success
    # A search that fails says nothing: the form does, when it is sent.
    page.route("**/v1/subjects?*", lambda route: route.abort())
    with page.expect_event("requestfailed"):
        tab.name_person("found-a")
    expect(enrolled).to_have_count(0)
    tab.open("People")
    tab.is_refused("The service does not respond.", "unreachable")
    assert set(tab.complaints) == {"Failed to load resource: net::ERR_FAILED"}
    tab.complaints.clear()


def test_an_enrollment_is_replaced_only_where_the_visitor_says_so(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo)
    page = tab.page
    verdict = page.locator(".verdict")
    dialog = page.get_by_role("dialog", name="Replace visitor’s enrollment?")
    button = page.get_by_role("button", name="Enroll", exact=True)

    def template_id() -> str:
        with demo.client() as client:
            return client.get("/v1/subjects/visitor").json()["template_id"]

    tab.open("Enroll")
    tab.name_person("visitor")
    tab.choose_drawn("person-1", 1)
    button.click()
    expect(verdict).to_contain_text("Earlier enrollmentnone")
    first = template_id()
    tab.choose_drawn("person-1", 2)
    button.click()
    expect(dialog.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(button).to_be_focused()
    expect(page.locator(".tray li")).to_have_count(1)
    assert template_id() == first

    # What somebody else enrolled while the question stood is not replaced by the answer.
    button.click()
    expect(dialog).to_be_visible()
    with demo.client() as client:
        client.delete("/v1/subjects/visitor")
    enroll(demo, "visitor", "person-1")
    meanwhile = template_id()
    dialog.get_by_role("button", name="Replace").click()
    tab.is_refused("enrollment_conflict")
    assert template_id() == meanwhile
    button.click()
    dialog.get_by_role("button", name="Replace").click()
    expect(verdict).to_contain_text("Earlier enrollmentreplaced")
    assert template_id() != meanwhile
    with demo.client() as client:
        assert client.delete("/v1/subjects/visitor").is_success


@pytest.mark.parametrize(
    ("status", "code", "says"),
    [
        (403, "forbidden", "a key that may do this"),
        (503, "model_unavailable", "Try again in a moment."),
    ],
)
def test_a_refusal_says_what_helps(
    open_tab: OpenTab, demo: Served, status: int, code: str, says: str
) -> None:
    tab = open_tab(demo)
    answer = refused(status, code, "it is refused")
    tab.page.route("**/verify", lambda route: route.fulfill(**answer))
    tab.name_person("person-2")
    tab.choose_drawn("person-2", 1)
    tab.press("Verify")
    tab.is_refused("It is refused.", code, says)
    tab.complaints[:] = [each for each in tab.complaints if "status of 503" not in each]


def test_a_receipt_is_good_for_the_contract_beside_it(
    open_tab: OpenTab, demo: Served, tmp_path: Path
) -> None:
    enroll(demo, "erased", "person-1")
    tab = open_tab(demo)
    page = tab.page
    tab.open("Service")
    with page.expect_download() as contract:
        tab.press("Download contract")
    contract.value.save_as(tmp_path / "contract.json")
    tab.open("People")
    tab.press("Erase erased")
    page.get_by_role("dialog").get_by_role("button", name="Erase", exact=True).click()
    with page.expect_download() as receipt:
        tab.press("Download receipt")
    receipt.value.save_as(tmp_path / "receipt.json")
    checked = run(
        "keys", "verify-receipt", tmp_path / "receipt.json",
        "--public-key", tmp_path / "contract.json",
    )  # fmt: skip
    assert checked.status == 0, checked.stderr


def test_what_is_no_picture_or_one_too_many_is_not_taken(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    tab.open("Enroll")
    tab.choose_files({"name": "key.txt", "mimeType": "text/plain", "buffer": b"key"})
    expect(tab.page.get_by_text("No picture: key.txt.")).to_be_visible()
    expect(tab.page.locator(".tray li")).to_have_count(0)
    assert not [url for url in tab.requests if url.endswith("/v1/photos/check")]
    # New photos take the place of those before; of too many, the first are taken.
    tab.open("Verify")
    people = demo.settings.data_dir / "people" / "person-2"
    photos = sorted(people.glob("*.png"))
    tab.choose_files(*(photos[n % len(photos)] for n in range(6)))
    expect(tab.page.locator(".tray li")).to_have_count(5)
    expect(tab.page.get_by_text("No more than 5 photos: these are the first.")).to_be_visible()
