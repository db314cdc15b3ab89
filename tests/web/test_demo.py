"""The demo deployment in the browser: a visitor without weights, and drawn people."""

import io
import re

import httpx
import pytest
from playwright.sync_api import expect

from tests.patience import PATIENCE_S
from tests.web.camera import browsers_test_picture
from tests.web.conftest import OpenTab
from tests.web.served import Served
from tests.web.walk import choose

pytestmark = pytest.mark.long


def test_an_enrollment_is_replaced_only_where_the_visitor_says_so(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo)
    page = tab.page
    enroll = page.get_by_role("button", name="Enroll", exact=True)

    def template_id() -> str:
        with demo.client() as client:
            return client.get("/v1/subjects/visitor").json()["template_id"]

    tab.open("Enroll")
    page.get_by_label("Person's id").fill("visitor")
    choose(tab, "person-1", 1)
    enroll.click()
    expect(page.locator(".verdict")).to_contain_text("Earlier enrollmentnone")
    first = template_id()

    choose(tab, "person-1", 2)
    enroll.click()
    dialog = page.get_by_role("dialog", name="Replace visitor’s enrollment?")
    expect(dialog.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(enroll).to_be_focused()
    expect(page.locator(".tray li")).to_have_count(1)
    assert template_id() == first
    enroll.click()
    dialog.get_by_role("button", name="Keep").click()
    expect(enroll).to_be_enabled()
    assert template_id() == first

    # What somebody else enrolled while the question stood is not replaced by the answer.
    enroll.click()
    expect(dialog).to_be_visible()
    photo = demo.settings.data_dir / "people" / "person-1" / "3.png"
    with demo.client() as client:
        sent = {"images": ("3.png", photo.read_bytes())}
        meanwhile = client.put("/v1/subjects/visitor/enrollment", files=sent).json()["template_id"]
    dialog.get_by_role("button", name="Replace").click()
    expect(page.get_by_role("alert")).to_contain_text("enrollment_conflict")
    assert template_id() == meanwhile

    enroll.click()
    dialog.get_by_role("button", name="Replace").click()
    expect(page.locator(".verdict")).to_contain_text("Earlier enrollmentreplaced")
    assert template_id() != meanwhile
    with demo.client() as client:
        assert client.delete("/v1/subjects/visitor").is_success


def test_people_come_page_by_page(open_tab: OpenTab, demo: Served) -> None:
    photo = (demo.settings.data_dir / "people" / "person-2" / "0.png").read_bytes()
    names = [f"many-{number:02}" for number in range(26)]
    with demo.client() as client:
        for name in names:
            answer = client.put(
                f"/v1/subjects/{name}/enrollment", files={"images": ("0.png", photo)}
            )
            assert answer.status_code == 201, answer.text
        tab = open_tab(demo)
        tab.open("People")
        cards = tab.page.locator("li.person")
        expect(cards).to_have_count(25)
        expect(tab.page.get_by_role("status").first).to_contain_text("with more to come")
        tab.page.get_by_role("button", name="Show more").click()
        total = len(client.get("/v1/subjects").json()["subjects"])
        expect(cards).to_have_count(total)
        expect(tab.page.get_by_role("button", name="Show more")).to_be_hidden()
        expect(cards.nth(25).get_by_role("link").first).to_be_focused()
        for name in names:
            client.delete(f"/v1/subjects/{name}")


def test_too_many_rejections_are_told_with_the_time_to_wait(
    open_tab: OpenTab, demo: Served
) -> None:
    stranger = (demo.settings.data_dir / "people" / "person-2" / "0.png").read_bytes()
    with demo.client() as client:
        enrolled = client.put(
            "/v1/subjects/locked/enrollment", files={"images": ("0.png", stranger)}
        )
        assert enrolled.is_success
        other = httpx.get(f"{demo.url}/demo/people/person-101/0.png", timeout=PATIENCE_S).content
        for _ in range(5):
            client.post("/v1/subjects/locked/verify", files={"image": ("0.png", other)})
        tab = open_tab(demo)
        tab.page.get_by_label("Person's id").fill("locked")
        choose(tab, "person-2", 1)
        tab.page.get_by_role("button", name="Verify", exact=True).click()
        alert = tab.page.get_by_role("alert")
        expect(alert).to_contain_text("locked_out")
        expect(alert).to_contain_text(re.compile(r"Try again in \d+ s"))
        assert len(re.findall(r"\d+ s\b", alert.inner_text())) == 1, "one clock"
        expect(alert).to_contain_text(re.compile(r"request [0-9a-f]{32}"))
        # An operator lifts it where it was met; others are not offered to.
        page = tab.page
        page.get_by_role("button", name="Lift the lock").click()
        expect(page.get_by_text("The lock on locked is lifted.")).to_be_visible()
        assert client.get("/v1/subjects/locked/lockout").status_code == 404
        page.get_by_role("button", name="Verify", exact=True).click()
        expect(page.locator(".verdict.accept")).to_be_visible()
        client.delete("/v1/subjects/locked")


def test_photos_are_numbered_from_one_in_the_tray_and_in_messages(
    open_tab: OpenTab, demo: Served
) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Enroll")
    page.get_by_label("Person's id").fill("mixed")
    choose(tab, "person-1", 1)
    choose(tab, "person-101", 1)
    numbers = page.locator(".tray .number")
    expect(numbers).to_have_text(["Photo 1", "Photo 2"])
    page.get_by_role("button", name="Enroll", exact=True).click()
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("Photos 1 and 2 do not look like the same person")

    picture = io.BytesIO()
    browsers_test_picture((240, 240)).save(picture, "PNG")
    page.get_by_label("Files", exact=True).check()
    page.locator("input[type=file]").set_input_files(
        {"name": "green.png", "mimeType": "image/png", "buffer": picture.getvalue()}
    )
    page.get_by_role("button", name="Remove photo from person-1, photo 1").click()
    expect(numbers).to_have_text(["Photo 1", "Photo 2"])
    expect(page.locator(".tray .seen").last).to_contain_text("No cartoon face found")
    page.get_by_role("button", name="Enroll", exact=True).click()
    expect(alert).to_contain_text("Photo 2 of 2: no cartoon face was found")
    expect(page.locator(".tray .seen").last).to_contain_text("No cartoon face was found")
    expect(page.locator(".tray .seen").first).not_to_contain_text("was found")


def test_the_mark_covers_nothing_that_has_the_focus(open_tab: OpenTab, demo: Served) -> None:
    tab = open_tab(demo)
    page = tab.page
    tab.open("Service")
    tab.open("Enroll")
    choose(tab, "person-1", 1)
    page.set_viewport_size({"width": 360, "height": 300})
    page.get_by_role("button", name="Enroll", exact=True).focus()
    visited = set()
    for _ in range(40):
        page.keyboard.press("Shift+Tab")
        name, top, mark = page.evaluate(
            """() => {
              const active = document.activeElement;
              const box = active.getBoundingClientRect();
              const mark = document.querySelector(".demo-mark").getBoundingClientRect();
              const inside = active.closest("main");
              return [inside ? active.outerHTML.slice(0, 80) : "", box.top, mark.bottom];
            }"""
        )
        if not name:
            break
        visited.add(name)
        assert top >= mark, name
    assert len(visited) > 5
