"""The API reference: what it is served with, and that the browser's policy lets it run."""

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import expect, sync_playwright

from api.http.app import create_app
from tests.api.client import Client
from tests.api.deployment import bearer, deploy
from tests.api.shapes import assert_error
from tests.clients.conftest import Running, service
from tests.web.browser_tab import BrowserTab
from tests.web.conftest import chromium

__all__ = ["chromium", "service"]

FILES = ("/docs", "/docs/start.js", "/docs/swagger-ui-bundle.js", "/docs/swagger-ui.css")
GROUPS = ["Enroll and verify", "People", "Tokens", "Operations"]


def test_its_policy_lets_nothing_of_another_origin_run(client: Client) -> None:
    for path in FILES:
        answer = client.get(path, headers={"Authorization": ""})
        assert answer.status_code == 200
        policy = answer.headers["content-security-policy"]
        assert policy.startswith("default-src 'none'; script-src 'self'; ")
        again = client.get(path, headers={"If-None-Match": answer.headers["etag"]})
        assert again.status_code == 304


def test_an_operator_switches_it_off(tmp_path: Path) -> None:
    with Client(create_app(deploy(tmp_path, web_page=False).settings)) as client:
        for path in FILES:
            assert_error(client.get(path), 404, "not_found")


@pytest.fixture
def tab(service: Running, chromium: Path) -> Iterator[BrowserTab]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium)
        tab = BrowserTab.of(browser.new_context(), service.url)
        yield tab
        browser.close()


@pytest.mark.long
def test_a_browser_shows_every_call_and_runs_one(service: Running, tab: BrowserTab) -> None:
    page = tab.page
    page.goto(f"{service.url}/docs")
    expect(page.locator(".opblock-tag")).to_have_count(len(GROUPS))
    assert [each.get_attribute("data-tag") for each in page.locator(".opblock-tag").all()] == GROUPS
    document = httpx.get(f"{service.url}/v1/openapi.json").json()
    expect(page.locator(".opblock")).to_have_count(sum(map(len, document["paths"].values())))
    page.get_by_role("button", name="Authorize").first.click()
    key = bearer(service.deployment.token)["Authorization"].removeprefix("Bearer ")
    page.get_by_label("auth-bearer-value").fill(key)
    page.get_by_role("button", name="Apply credentials").first.click()
    page.get_by_role("button", name="Close").first.click()
    page.locator("#operations-Operations-getOwnKey").click()
    page.get_by_role("button", name="Try it out").click()
    page.get_by_role("button", name="Execute").click()
    expect(page.locator(".live-responses-table .response-col_status").last).to_contain_text("200")
    assert (tab.complaints, tab.strays(), page.evaluate("window.violations")) == ([], [], [])
