"""Real faces before a fake camera: enroll, accept, reject, erase."""

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.api.cli.conftest import run
from tests.web.camera import FakeCamera
from tests.web.conftest import OpenTab
from tests.web.deployments import OTHER, WHO
from tests.web.served import Served

pytestmark = pytest.mark.long


def test_one_person_from_enrollment_to_erasure(
    open_tab: OpenTab,
    real: Served,
    camera: FakeCamera,
    people: dict[str, list[Path]],
    tmp_path: Path,
) -> None:
    own, other = people[WHO], people[OTHER]
    with real.client() as client:  # whom an earlier test enrolled: at the end, nobody is left
        for subject in client.get("/v1/subjects").json()["subjects"]:
            assert client.delete(f"/v1/subjects/{subject['subject_id']}").is_success
    tab = open_tab(real)
    page = tab.page

    tab.open("Enroll")
    tab.name_person("anna")
    camera.shows(own[0])
    tab.start_camera()
    tab.guided("Good: one face")
    tab.press("Take 3 photos")
    # Another photo from a file, as a visitor may mix them.
    tab.choose_files(own[1])
    tab.good(4)
    # Each has the box where the service found the face.
    expect(page.locator(".tray .found:not([hidden])")).to_have_count(4)
    with real.client() as client:
        box = client.post("/v1/photos/check", files={"image": own[1].read_bytes()}).json()["box"]
    drawn = page.locator(".tray .found").last
    x, y, width, height = (
        float(drawn.get_attribute(name) or "nan") for name in ("x", "y", "width", "height")
    )
    assert [x, y, x + width, y + height] == pytest.approx(box)
    assert page.locator(".tray .overlay").last.get_attribute("viewBox") == "0 0 250 250"
    tab.press("Enroll")
    expect(page.locator(".verdict")).to_contain_text("Enrolled")
    expect(page.get_by_role("list", name="Photos used").locator("img")).to_have_count(4)
    expect(page.locator(".verdict .found:not([hidden])")).to_have_count(4)
    expect(page.locator(".verdict")).to_be_focused()
    page.get_by_role("link", name="Verify this person").click()

    expect(page.get_by_role("heading", level=1, name="Verify")).to_be_focused()
    expect(page.get_by_label("Person’s id")).to_have_value("anna")
    page.get_by_label("Level").select_option("fmr-1e-1")
    camera.shows(own[2])
    tab.start_camera()
    tab.press("Verify")
    tab.is_decided("accept")
    expect(page.locator(".verdict")).to_contain_text("10 % (1 in 10)")

    camera.shows(other[0])
    tab.open("People")
    page.get_by_role("link", name="Verify anna").click()
    expect(page.get_by_role("heading", level=1, name="Verify")).to_be_focused()
    tab.start_camera()
    tab.press("Verify")
    tab.is_decided("reject")
    expect(page.locator(".tray li")).to_have_count(3)
    expect(page.locator(".verdict")).to_contain_text("anna, at level fmr-1e-2")

    tab.open("Service")
    with page.expect_download() as contract:
        page.get_by_role("button", name="Download contract").click()
    contract.value.save_as(tmp_path / "contract.json")
    tab.open("People")
    tab.press("Erase anna")
    page.get_by_role("dialog").get_by_role("button", name="Erase", exact=True).click()
    expect(page.locator(".verdict")).to_contain_text("Erased anna")
    expect(page.get_by_text("Nobody is enrolled yet")).to_be_visible()
    with page.expect_download() as receipt:
        page.get_by_role("button", name="Download receipt").click()
    receipt.value.save_as(tmp_path / "receipt.json")
    checked = run(
        "keys", "verify-receipt", tmp_path / "receipt.json",
        "--public-key", tmp_path / "contract.json",
    )  # fmt: skip
    assert checked.status == 0, checked.stderr
    with real.client() as client:
        assert client.get("/v1/subjects/anna").status_code == 404


def test_photos_that_the_service_refuses_are_named(
    open_tab: OpenTab, real: Served, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(real)
    page = tab.page
    own, other = people[WHO], people[OTHER]
    with real.client() as client:
        enrolled = [("images", ("0.jpg", own[0].read_bytes()))]
        assert client.put("/v1/subjects/two-people/enrollment", files=enrolled).is_success
    tab.name_person("two-people")
    tab.choose_files(own[0], other[0], own[1])
    tab.press("Verify")
    tab.is_refused("Photo 2 does not look like the person on photos 1 and 3")
    bad = page.locator(".tray .seen[data-state=bad]")
    expect(bad).to_have_count(1)
    expect(page.locator(".tray li").nth(1)).to_contain_text("Does not look like")
    # What is chosen next replaces them.
    tab.choose_files(*own[:5], other[0])
    expect(page.locator(".tray li")).to_have_count(5)
    expect(page.get_by_text("No more than 5 photos: these are the first.")).to_be_visible()
    with real.client() as client:
        assert client.delete("/v1/subjects/two-people").is_success
