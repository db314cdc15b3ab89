"""The application examples: a password first, then a face, with a token that the page holds."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser

from tests.examples.conftest import EXAMPLES, PYTHON, Service, clean_environment, node, running
from tests.patience import wait_until
from tests.ports import free_port
from tests.web.conftest import chromium, running_browser
from veilface_client import Client

__all__ = ["chromium"]

pytestmark = pytest.mark.long
PASSWORD = "correct horse"


@pytest.fixture(scope="module")
def browser(chromium: Path) -> Iterator[Browser]:
    with running_browser(chromium) as opened:
        yield opened


@pytest.fixture(params=["app.py", "app.mjs"], scope="module")
def app(
    request: pytest.FixtureRequest, service: Service, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[str]:
    python = request.param.endswith(".py")
    port = service.pages[0 if python else 1]
    env = clean_environment(
        VEILFACE_URL=service.url, VEILFACE_API_KEY=service.token, PORT=str(port)
    )
    log = tmp_path_factory.mktemp("app") / "app.log"
    arguments = [PYTHON if python else node(), str(EXAMPLES / "app" / request.param)]
    with running(arguments, f"http://127.0.0.1:{port}/", env, log) as url:
        yield url


class Visitor:
    """A browser: it keeps the session that it was given last."""

    def __init__(self, url: str) -> None:
        self._url, self.session = url, ""

    def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        headers = {"Cookie": f"session={self.session}"} if self.session else {}
        answer = httpx.request(method, self._url + path, headers=headers, timeout=60, **options)
        if cookie := answer.headers.get("Set-Cookie"):
            assert {part.strip().lower() for part in cookie.split(";")} >= {
                "httponly", "secure", "samesite=strict",
            }  # fmt: skip
            self.session = cookie.split(";")[0].removeprefix("session=")
        return answer

    def sign(self, path: str, name: str, password: str = PASSWORD) -> int:
        return self.send("POST", path, json={"name": name, "password": password}).status_code

    def show(self, photo: bytes) -> dict[str, Any]:
        """Do what the page does; return what it was given."""
        given: dict[str, Any] = self.send("POST", "token").json()
        answer = httpx.request(
            given["method"],
            given["url"],
            files={"images": photo},
            headers={"Authorization": f"Bearer {given['token']}"},
            timeout=60,
        )
        assert answer.is_success, answer.text
        return given

    @property
    def is_in(self) -> bool:
        return self.send("GET", "account").status_code == 200


def test_password_and_face_together_open_an_account(app: str, service: Service) -> None:
    visitor = Visitor(app)
    assert visitor.send("POST", "token").status_code == 401
    assert visitor.sign("register", "ann") == 201
    assert Visitor(app).sign("register", "ann") == 409
    assert not visitor.is_in
    given = visitor.show(service.photo(1, 0))
    assert given["action"] == "enroll"
    before = visitor.session
    assert visitor.send("POST", "face").json() == {"accepted": True}
    assert visitor.is_in
    assert visitor.session != before

    again = Visitor(app)
    assert again.sign("login", "ann", "wrong password") == 401
    assert again.sign("login", "nobody") == 401
    assert again.sign("login", "ann") == 204
    assert not again.is_in
    assert again.show(service.photo(1, 4))["action"] == "verify"
    assert again.send("POST", "face").json() == {"accepted": True}
    assert again.is_in


def test_who_knows_the_password_alone_stays_out(app: str, service: Service) -> None:
    owner = Visitor(app)
    assert owner.sign("register", "eve") == 201
    owner.show(service.photo(2, 0))
    assert owner.send("POST", "face").json() == {"accepted": True}
    thief = Visitor(app)
    assert thief.sign("login", "eve") == 204
    # Without a token, with one that was not used, and with another face.
    assert thief.send("POST", "face").status_code == 409
    given = thief.send("POST", "token").json()
    assert thief.send("POST", "face").json() == {"accepted": False}
    assert given["action"] == "verify"
    thief.show(service.photo(3, 0))
    assert thief.send("POST", "face").json() == {"accepted": False}
    assert not thief.is_in
    # The token enrolls nobody, and the session of the thief learns nothing of the owner's.
    refused = httpx.put(
        given["url"].replace("/verify", "/enrollment"),
        files={"images": service.photo(3, 0)},
        headers={"Authorization": f"Bearer {given['token']}"},
        timeout=60,
    )
    assert (refused.status_code, refused.json()["error"]["code"]) == (403, "forbidden")
    subject = given["url"].split("/")[-2]
    with Client(service.url, service.token) as client:
        client.reset_lockout(subject)


def test_an_older_token_replaces_no_face(app: str, service: Service) -> None:
    """Who knew the password before the first face came holds a token that enrolls."""
    owner, thief = Visitor(app), Visitor(app)
    assert owner.sign("register", "fay") == 201
    assert thief.sign("login", "fay") == 204
    given = thief.send("POST", "token").json()
    owner.show(service.photo(1, 0))
    assert given["action"] == "enroll"
    refused = httpx.put(
        given["url"],
        files={"images": service.photo(3, 0)},
        headers={"Authorization": f"Bearer {given['token']}"},
        timeout=60,
    )
    assert refused.json()["error"]["code"] == "enrollment_conflict"
    assert thief.send("POST", "face").json() == {"accepted": False}
    assert owner.send("POST", "face").json() == {"accepted": True}


def test_only_texts_are_a_name_and_a_password(app: str) -> None:
    for name, password in (
        (["gus"], PASSWORD),
        ("gus", [PASSWORD]),
        ("gus", 1234567890),
        (7, None),
    ):
        answer = Visitor(app).send("POST", "register", json={"name": name, "password": password})
        assert answer.status_code == 422
    assert Visitor(app).send("POST", "register", json=None).status_code in (400, 422)


def test_the_page_is_served_with_its_policy(app: str, service: Service) -> None:
    page, script = httpx.get(app), httpx.get(f"{app}page.js")
    policy = page.headers["Content-Security-Policy"]
    assert f"connect-src 'self' {service.url}" in policy
    assert "unsafe" not in policy
    assert "javascript" in script.headers["Content-Type"]
    assert page.text == (EXAMPLES / "app" / "index.html").read_text()


def test_nobody_gets_in_while_the_service_is_away(tmp_path: Path) -> None:
    port, nobody = free_port(), free_port()
    for name, program in (("app.py", PYTHON), ("app.mjs", node())):
        env = clean_environment(
            VEILFACE_URL=f"http://127.0.0.1:{nobody}",
            VEILFACE_API_KEY="vf_000000000000_" + "0" * 64,
            PORT=str(port),
        )
        arguments = [program, str(EXAMPLES / "app" / name)]
        with running(arguments, f"http://127.0.0.1:{port}/", env, tmp_path / "log") as url:
            visitor = Visitor(url)
            assert visitor.sign("register", "ann") == 201
            assert visitor.send("POST", "token").status_code == 502
            assert not visitor.is_in


def fill_in(page: Any, name: str, photo: bytes, button: str) -> None:
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(PASSWORD)
    file = {"name": "me.png", "mimeType": "image/png", "buffer": photo}
    page.get_by_label("Photo").set_input_files(file)
    page.get_by_role("button", name=button).click()


def test_a_browser_shows_a_photo_to_the_service_alone(
    app: str, service: Service, browser: Any
) -> None:
    """The page's own server never gets the photo, and the browser never the server's key."""
    context = browser.new_context()
    page = context.new_page()
    sent: list[tuple[str, str, bytes]] = []
    page.on(
        "request",
        lambda seen: sent.append(
            (seen.url, seen.headers.get("content-type", ""), seen.post_data_buffer or b"")
        ),
    )
    photos = {person: service.photo(person, 0) for person in (4, 1)}

    def submit(button: str, person: int, told: str) -> None:
        page.goto(app)
        fill_in(page, "zoe", photos[person], button)
        page.get_by_text(told).wait_for(timeout=600_000)

    submit("Register", 4, "Welcome, zoe")
    submit("Sign in", 4, "Welcome, zoe")
    submit("Sign in", 1, "This is somebody else")
    own = [(kind, body) for url, kind, body in sent if url.startswith(app)]
    others = [url for url, _, _ in sent if url.startswith(service.url)]
    assert [url.split("/")[-1] for url in others] == ["enrollment", "verify", "verify"]
    assert len(own) + len(others) == len(sent)
    # Names and passwords, and nothing that could hold a file.
    assert {kind for kind, _ in own} == {"", "application/json"}
    assert max(len(body) for _, body in own) < 100
    assert not any(service.token.encode() in body for _, _, body in sent)
    context.close()


def test_the_page_waits_for_a_sending_that_is_still_at_work(
    app: str, service: Service, browser: Any
) -> None:
    """The first sending is lost on its way, the second is told that an earlier one still runs."""
    context = browser.new_context()
    page = context.new_page()
    asked: list[str] = []
    page.on("request", lambda seen: asked.append(seen.url.split("/")[-1]))
    sendings = []

    def at_work(route: Any) -> None:
        sendings.append(route.request.headers["idempotency-key"])
        if len(sendings) == 1:
            route.abort()
        elif len(sendings) == 2:
            route.fulfill(
                status=409,
                headers={"Access-Control-Allow-Origin": app.rstrip("/")},
                json={"error": {"code": "idempotency_conflict", "message": "", "details": {}}},
            )
        else:
            route.continue_()

    page.route("**/enrollment", at_work)
    page.goto(app)
    fill_in(page, "ida", service.photo(1, 0), "Register")
    page.locator("output").get_by_text("ida").wait_for(timeout=600_000)
    assert page.locator("output").text_content() == "Welcome, ida"
    assert len(sendings) == 3
    assert len(set(sendings)) == 1, "one attempt"
    assert [name for name in asked if name in ("enrollment", "face")][-2:] == ["enrollment", "face"]
    assert asked.count("face") == 1
    context.close()


@pytest.mark.long
def test_the_page_does_not_wait_for_ever(app: str, service: Service, browser: Any) -> None:
    """By its clock it is told for two hours that an earlier sending is still at work."""
    context = browser.new_context()
    page = context.new_page()
    page.clock.install()
    refusal = {
        "status": 409,
        "headers": {"Access-Control-Allow-Origin": app.rstrip("/")},
        "json": {"error": {"code": "idempotency_conflict", "message": "still at work"}},
    }
    asked: list[str] = []

    def at_work(route: Any) -> None:
        asked.append(route.request.url)
        route.fulfill(**refusal)

    page.route("**/enrollment", at_work)
    page.goto(app)
    fill_in(page, "joe", service.photo(1, 0), "Register")
    wait_until(lambda: page.evaluate("0") or len(asked) > 1, what="a second sending")
    page.clock.fast_forward("02:00:00")
    page.locator("output").get_by_text("still at work").wait_for(timeout=600_000)
    context.close()
