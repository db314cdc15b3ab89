"""People are searched and suggested, photos are dropped, and what was found is printed."""

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from tests.web.conftest import OpenTab
from tests.web.served import Served
from tests.web.walk import choose

pytestmark = pytest.mark.long

NAMES = ("found-ada", "found-ben", "found-ben-2")


@pytest.fixture(autouse=True)
def enrolled(demo: Served) -> Iterator[None]:
    """Three people whose ids begin alike."""
    photo = (demo.settings.data_dir / "people" / "person-2" / "0.png").read_bytes()
    with demo.client() as client:
        for name in NAMES:
            path = f"/v1/subjects/{name}/enrollment"
            assert client.put(path, files={"images": ("0.png", photo)}).is_success
        yield
        for name in NAMES:
            assert client.delete(f"/v1/subjects/{name}").is_success


@pytest.mark.parametrize("view", ["Verify", "Enroll"])
def test_people_whose_ids_begin_so_are_suggested(
    open_tab: OpenTab, demo: Served, view: str
) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open(view)
    field = page.get_by_label("Person's id")
    suggested = page.locator(f"datalist#{field.get_attribute('list')} option")
    field.press_sequentially("found-")
    expect(suggested).to_have_count(3)
    expect(suggested.last).to_have_text(re.compile("^1 photo, enrolled "))
    expect(page.get_by_text("3 people found.")).to_be_visible()
    # One that is enrolled is enough said, though another id begins with it.
    field.fill("found-ben")
    expect(page.get_by_text("✓ 1 photo, enrolled")).to_be_visible()


def test_an_id_that_nobody_has_is_typed_as_it_is(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    field = page.get_by_label("Person's id")
    field.fill("found-nobody")
    expect(page.get_by_text("Nobody is enrolled under this id.")).to_be_visible()
    choose(tab, "person-2", 1)
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.get_by_role("alert")).to_contain_text("not_enrolled")
    # A search that fails says nothing: the form does, when it is sent.
    page.route("**/v1/subjects?*", lambda route: route.abort())
    with (
        page.expect_console_message(lambda said: "ERR_FAILED" in said.text),
        page.expect_event("requestfailed"),
    ):
        field.fill("found-a")
    expect(page.get_by_text("Nobody is enrolled under this id.")).to_have_count(0)
    expect(page.locator("datalist option")).to_have_count(0)
    assert set(tab.complaints) == {"Failed to load resource: net::ERR_FAILED"}
    tab.complaints.clear()


def test_who_may_not_list_people_types_the_id(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, sign_in=demo.key("verify"))
    page = tab.page
    page.get_by_label("Person's id").fill("found-")
    choose(tab, "person-2", 1)
    expect(page.locator("datalist")).to_have_count(0)
    assert not [url for url in tab.requests if "/v1/subjects" in url]


def test_people_are_found_by_how_their_ids_begin(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("People")
    people = page.locator("li.person")
    expect(people.filter(has_text="person-2")).to_have_count(1)
    search = page.get_by_label("Find people whose id begins with")
    search.fill("found-ben")
    expect(people).to_have_count(2)
    expect(page.get_by_text("2 people shown.")).to_be_visible()
    search.fill("found-z")
    expect(page.get_by_text("Nobody’s id begins so.")).to_be_visible()
    expect(page.get_by_text("Enroll the first person")).to_be_hidden()
    search.fill("found-a")
    expect(people).to_have_count(1)


DROP = """
async ([selector, url]) => {
  const data = new DataTransfer();
  const add = (parts, name, type) => data.items.add(new File(parts, name, { type }));
  if (url === "text") data.setData("text/plain", "dragged");
  else if (url === "key file") add(["key"], "key.txt", "text/plain");
  else add([await (await fetch(url)).blob()], "dropped.png", "image/png");
  const target = document.querySelector(selector);
  const told = { bubbles: true, cancelable: true, dataTransfer: data };
  const over = !target.dispatchEvent(new DragEvent("dragover", told));
  const lit = document.querySelector("form.dropping") !== null;
  return [over, lit, !target.dispatchEvent(new DragEvent("drop", told))];
}
"""
"""Drop a picture, a key file or text on an element; whether the page takes it over from the browser
while it is above, lights up its form, and takes it over when it is dropped."""


def test_photos_are_dropped_on_the_form(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Enroll")
    url = "/demo/people/person-1/0.png"
    for count in (1, 2):
        assert page.evaluate(DROP, ["form", url]) == [True, True, True]
        expect(page.locator(".tray .seen[data-state=good]")).to_have_count(count)
    expect(page.locator("form.dropping")).to_have_count(0)
    expect(page.get_by_label("Remove photo from dropped.png")).to_have_count(2)
    # What misses the form is taken by nobody, and does not replace the page.
    assert page.evaluate(DROP, ["h1", url]) == [True, False, True]
    expect(page.locator(".tray li")).to_have_count(2)
    # What is no picture is not sent anywhere; the field for the key file takes it by itself; and
    # text is dragged as ever.
    assert page.evaluate(DROP, ["form", "key file"]) == [True, True, True]
    expect(page.get_by_text("No picture: key.txt.")).to_be_visible()
    page.get_by_label("Lock to a key file").check()
    for dropped in ("key file", url):
        field = "input[type=file][required]"
        assert page.evaluate(DROP, [field, dropped]) == [False, False, False]
    assert page.evaluate(DROP, ["h1", "text"]) == [False, False, False]
    expect(page.locator(".tray li")).to_have_count(2)
    # Where the form is switched off, it takes nothing.
    tab.sign_in(demo.key("verify"))
    tab.open("Enroll")
    assert page.evaluate(DROP, ["form", url])[1] is False


def test_what_is_printed_is_what_was_found(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo, color_scheme="dark")
    page = tab.page
    page.get_by_label("Person's id").fill("found-ada")
    choose(tab, "person-2", 1)
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.accept")).to_be_visible()
    page.emulate_media(media="print")
    expect(page.locator(".verdict")).to_be_visible()
    expect(page.get_by_text("demo model: not for authentication").first).to_be_visible()
    for hidden in ("navigation", "button"):
        expect(page.get_by_role(hidden)).to_have_count(0)
    ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == "rgb(255, 255, 255)"
