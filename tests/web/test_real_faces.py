"""Real faces before a fake camera: enroll, accept, reject, erase, and guidance on the way."""

from pathlib import Path

import pytest
from playwright.sync_api import expect

from tests.api.cli.conftest import run
from tests.web.access import assert_accessible
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
    page.get_by_label("Person's id").fill("anna")
    camera.shows(own[0])
    tab.take_photos()
    tab.guided("Good: one face")
    # Another photo from a file, as a visitor may mix them.
    page.get_by_label("Files").check()
    page.get_by_label("Photos: JPEG").set_input_files(own[1])
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(4)
    # Each has the box where the service found the face.
    expect(page.locator(".tray .found:not([hidden])")).to_have_count(4)
    with real.client() as client:
        told = client.post("/v1/photos/check", files={"image": own[1].read_bytes()}).json()["box"]
    drawn = page.locator(".tray .found").last
    x, y, width, height = (
        float(drawn.get_attribute(name) or "nan") for name in ("x", "y", "width", "height")
    )
    assert [x, y, x + width, y + height] == pytest.approx(told)
    assert page.locator(".tray .overlay").last.get_attribute("viewBox") == "0 0 250 250"
    page.get_by_role("button", name="Enroll", exact=True).click()
    expect(page.locator(".verdict")).to_contain_text("Enrolled")
    expect(page.get_by_role("list", name="Photos used").locator("img")).to_have_count(4)
    expect(page.locator(".verdict .found:not([hidden])")).to_have_count(4)
    expect(page.locator(".verdict")).to_be_focused()
    page.get_by_role("link", name="Verify this person").click()

    expect(page.get_by_label("Person's id")).to_have_value("anna")
    page.get_by_label("Level").select_option("fmr-1e-1")
    camera.shows(own[2])
    tab.take_photos()
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.accept")).to_contain_text("Accepted")
    expect(page.locator(".verdict")).to_contain_text("10 % (1 in 10)")

    camera.shows(other[0])
    tab.open("People")
    page.get_by_role("link", name="Verify anna").click()
    tab.take_photos()
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(page.locator(".verdict.reject")).to_contain_text("Rejected")
    expect(page.locator(".tray li")).to_have_count(3)
    expect(page.locator(".verdict")).to_contain_text("no_match")
    expect(page.locator(".verdict")).to_contain_text("fmr-1e-2")

    tab.open("Service")
    with page.expect_download() as contract:
        page.get_by_role("button", name="Download contract").click()
    contract.value.save_as(tmp_path / "contract.json")
    tab.open("People")
    page.get_by_role("button", name="Erase anna").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="Keep")).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.get_by_role("button", name="Erase anna")).to_be_focused()
    page.get_by_role("button", name="Erase anna").click()
    dialog.get_by_role("button", name="Erase", exact=True).click()
    expect(page.locator(".verdict")).to_contain_text("Erased anna")
    expect(page.get_by_text("Nobody is enrolled yet.")).to_be_visible()
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


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        ("nobody", "No face found"),
        ("two", "2 faces found"),
        ("dark", "Too dark"),
        ("one", "Good: one face"),
    ],
)
def test_guidance_says_what_the_camera_shows(
    open_tab: OpenTab,
    real: Served,
    camera: FakeCamera,
    people: dict[str, list[Path]],
    shown: str,
    words: str,
) -> None:
    one, other = people[WHO][0], people[OTHER][0]
    match shown:
        case "nobody":
            camera.shows()
        case "two":
            camera.shows(one, other)
        case "dark":
            camera.shows(one, dark=0.14)
        case _:
            camera.shows(one)
    tab = open_tab(real, width=360)
    tab.page.get_by_role("button", name="Start camera").click()
    tab.guided(words)
    assert_accessible(tab, f"camera-{shown}")
    assert any(url.endswith("/v1/photos/check") for url in tab.requests)
    good = shown == "one"
    expect(tab.page.locator(".found")).to_be_visible(visible=good)


def test_photos_that_the_service_refuses_are_named(
    open_tab: OpenTab, real: Served, people: dict[str, list[Path]]
) -> None:
    tab = open_tab(real)
    page = tab.page
    tab.open("Enroll")
    page.get_by_label("Person's id").fill("two-people")
    page.get_by_label("Files").check()
    page.get_by_label("Photos: JPEG").set_input_files([people[WHO][0], people[OTHER][0]])
    expect(page.locator(".tray .seen[data-state=good]")).to_have_count(2)
    page.get_by_role("button", name="Enroll", exact=True).click()
    alert = page.get_by_role("alert")
    expect(alert).to_contain_text("inconsistent_images")
    expect(alert).to_contain_text("Remove the photos that show somebody else")
    expect(page.locator(".tray .seen[data-state=bad]")).to_have_count(2)
    with real.client() as client:
        assert client.get("/v1/subjects/two-people").status_code == 404
    # A verification names the one of three; what is chosen next replaces them.
    tab.open("Verify")
    page.get_by_label("Person's id").fill("two-people")
    page.get_by_label("Files").check()
    files = page.get_by_label("Photos: JPEG")
    with real.client() as client:
        enrolled = [("images", ("0.jpg", people[WHO][0].read_bytes()))]
        assert client.put("/v1/subjects/two-people/enrollment", files=enrolled).is_success
    files.set_input_files([people[WHO][0], people[OTHER][0], people[WHO][1]])
    page.get_by_role("button", name="Verify", exact=True).click()
    expect(alert).to_contain_text("Photo 2 does not look like the person on photos 1 and 3")
    expect(page.locator(".tray li").nth(1).locator(".seen[data-state=bad]")).to_be_visible()
    expect(page.locator(".tray .seen[data-state=bad]")).to_have_count(1)
    files.set_input_files([*people[WHO][:5], people[OTHER][0]])
    expect(page.locator(".tray li")).to_have_count(5)
    expect(page.get_by_text("No more than 5 photos: these are the first.")).to_be_visible()
    with real.client() as client:
        assert client.delete("/v1/subjects/two-people").is_success
