"""Forms: whom they are about, photos that are dropped, and what comes late."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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
DROP = """
async ([selector, url]) => {
  const data = new DataTransfer();
  const add = (parts, name, type) => data.items.add(new File(parts, name, { type }));
  if (url === "text") data.setData("text/plain", "dragged");
  else if (url === "key file") add(["key"], "key.txt", "text/plain");
  else add([await (await fetch(url)).blob()], "dropped.png", "image/png");
  const target = document.querySelector(selector);
  const options = { bubbles: true, cancelable: true, dataTransfer: data };
  const over = !target.dispatchEvent(new DragEvent("dragover", options));
  return [over, !target.dispatchEvent(new DragEvent("drop", options))];
}
"""
"""Drop a picture, a key file or text on an element; whether the page takes it over from the browser
while it is above, and when it is dropped."""


@pytest.fixture
def enrolled(demo: Served) -> Iterator[None]:
    """Three people whose ids begin alike."""
    for name in NAMES:
        enroll(demo, name, "person-2")
    yield
    with demo.client() as client:
        for name in NAMES:
            assert client.delete(f"/v1/subjects/{name}").is_success


@pytest.mark.usefixtures("enrolled")
def test_people_whose_ids_begin_so_are_suggested(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    field = page.get_by_label("Person’s id")
    suggested = page.locator(f"datalist#{field.get_attribute('list')} option")
    field.press_sequentially("found-")
    expect(suggested).to_have_count(3)
    expect(suggested.last).to_have_text(re.compile("^1 photo, "))
    expect(page.get_by_text("3 people found.")).to_be_visible()
    # One that is enrolled is enough said, though another id begins with it.
    field.fill("found-ben")
    expect(page.get_by_text("✓ Enrolled: 1 photo")).to_be_visible()
    # As the service does, the page reads an id in Unicode's form NFC.
    enroll(demo, DECOMPOSED, "person-2")
    field.fill(DECOMPOSED)
    expect(page.get_by_text("✓ Enrolled: 1 photo")).to_be_visible()
    with demo.client() as client:
        assert client.delete(f"/v1/subjects/{DECOMPOSED}").is_success
    # A search that fails says nothing: the form does, when it is sent.
    page.route("**/v1/subjects?*", lambda route: route.abort())
    with page.expect_event("requestfailed"):
        field.fill("found-a")
    expect(page.get_by_text("✓ Enrolled")).to_have_count(0)
    expect(suggested).to_have_count(0)
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
    ("status", "code", "details", "says"),
    [
        (403, "forbidden", {"missing": ["verify"]}, "a key that has this right"),
        (403, "forbidden", {"lowest_level": "fmr-1e-3"}, "Choose a stricter level"),
        (403, "forbidden", {"tenant_setting": "x"}, "Switch private mode off"),
        (403, "forbidden", {"liveness": "passive"}, "Reload the page"),
        (403, "forbidden", {}, "Ask the operator whether this key may do it."),
        (503, "model_unavailable", {}, "Try again in a moment."),
    ],
)
def test_a_refusal_says_what_helps(
    open_tab: OpenTab, demo: Served, status: int, code: str, details: dict[str, Any], says: str
) -> None:
    tab = open_tab(demo)
    answer = refused(status, code, "it is refused", **details)
    tab.page.route("**/verify", lambda route: route.fulfill(**answer))
    tab.name_person("person-2")
    tab.choose_drawn("person-2", 1)
    tab.press("Verify")
    tab.is_refused(code, says)
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


def test_photos_are_dropped_on_the_form(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Enroll")
    url = "/demo/people/person-1/0.png"
    for count in (1, 2):
        assert page.evaluate(DROP, ["form", url]) == [True, True]
        tab.good(count)
    # What misses the form is taken by nobody, and does not replace the page.
    assert page.evaluate(DROP, ["h1", url]) == [True, True]
    assert page.evaluate(DROP, ["h1", "text"]) == [False, False]
    # What is no picture is not sent anywhere.
    assert page.evaluate(DROP, ["form", "key file"]) == [True, True]
    expect(page.get_by_text("No picture: key.txt.")).to_be_visible()
    expect(page.locator(".tray li")).to_have_count(2)
    # Where the form is switched off, it takes nothing.
    tab.sign_in(demo.key("verify"))
    tab.open("Enroll")
    page.evaluate(DROP, ["form", url])
    expect(page.locator(".tray li")).to_have_count(0)
