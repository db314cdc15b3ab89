"""The application in both backends: a password first, then a face, of which a template is sent."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from tests.clients.conftest import Running
from tests.clients.javascript.conftest import require_client
from tests.clients.proxy import Proxy
from tests.clients.recorded import requests_in
from tests.examples.conftest import EXAMPLES, PYTHON, clean_environment, node, running
from tests.patience import wait_until
from tests.ports import free_port
from tests.web.browser_tab import BrowserTab
from tests.web.camera import FakeCamera
from tests.web.conftest import camera, chromium, people, running_browser
from tests.web.deployments import OTHER, WHO, private_service

__all__ = ["camera", "chromium", "people"]

pytestmark = pytest.mark.long
PASSWORD = "correct horse"
JSON = {"Content-Type": "application/json"}
BACKENDS = ("app.py", "app.mjs")


@dataclass(frozen=True)
class Place:
    """The service, and the application of each backend; proxies keep what comes to them."""

    running: Running
    service: Proxy
    apps: dict[str, Proxy]
    ports: dict[str, int]

    def key(self, **options: Any) -> str:
        """What docs/login.md says that the application needs, and no more."""
        deployment = self.running.deployment
        key = deployment.key("enroll", "verify", "embeddings", tenant="app", **options)
        deployment.allow_templates("app")
        return key

    def environment(self, key: str, backend: str) -> dict[str, str]:
        return clean_environment(
            VEILFACE_URL=self.service.url, VEILFACE_API_KEY=key, PORT=str(self.ports[backend])
        )


@pytest.fixture(scope="module")
def browser(chromium: Path, camera: FakeCamera) -> Iterator[Browser]:
    with running_browser(chromium, *camera.flags) as opened:
        yield opened


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, mbf_pack_dir: Path) -> Iterator[Place]:
    require_client()
    ports = {backend: free_port() for backend in (*BACKENDS, "strict")}
    with ExitStack() as stack:
        apps = {name: stack.enter_context(Proxy(port)) for name, port in ports.items()}
        origins = ",".join(proxy.url for proxy in apps.values())
        folder = tmp_path_factory.mktemp("private")
        service = stack.enter_context(private_service(folder, mbf_pack_dir, cors_origins=origins))
        recording = stack.enter_context(Proxy(service.port))
        yield Place(service, recording, apps, ports)


@pytest.fixture(params=BACKENDS, scope="module")
def app(
    request: pytest.FixtureRequest, place: Place, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Proxy]:
    name = request.param
    log = tmp_path_factory.mktemp("app") / "app.log"
    with running(command(name), direct(place, name), place.environment(place.key(), name), log):
        yield place.apps[name]


def command(backend: str) -> list[str]:
    return [PYTHON if backend == "app.py" else node(), str(EXAMPLES / "app" / backend)]


def direct(place: Place, backend: str) -> str:
    return f"http://127.0.0.1:{place.ports[backend]}/"


class Visitor:
    """A program in the place of the page: it keeps the session that it was given last."""

    def __init__(self, url: str) -> None:
        self._url, self.session = url, ""

    def send(self, method: str, path: str, **options: Any) -> httpx.Response:
        headers = options.pop("headers", {})
        if self.session:
            headers = {**headers, "Cookie": f"session={self.session}"}
        answer = httpx.request(
            method, f"{self._url}/{path}", headers=headers, timeout=60, **options
        )
        if cookie := answer.headers.get("Set-Cookie"):
            assert {part.strip().lower() for part in cookie.split(";")} >= {
                "httponly", "secure", "samesite=strict",
            }  # fmt: skip
            self.session = cookie.split(";")[0].removeprefix("session=")
        return answer

    def sign(self, path: str, name: str, password: str = PASSWORD) -> int:
        return self.send("POST", path, json={"name": name, "password": password}).status_code

    def token(self) -> dict[str, str]:
        given: dict[str, str] = self.send("POST", "token").json()
        return given

    def show(self, photo: Path) -> dict[str, str]:
        """Use a token as whoever holds it can; return what it was given."""
        given = self.token()
        answer = use(given, given["action"], photo)
        assert answer.is_success, answer.text
        return given

    @property
    def is_in(self) -> bool:
        return self.send("GET", "account").status_code == 200

    @property
    def accepted(self) -> bool:
        answer = self.send("POST", "face").json()
        return answer["accepted"] is True


def use(given: dict[str, str], action: str, photo: Path) -> httpx.Response:
    method, path = {"enroll": ("PUT", "enrollment"), "verify": ("POST", "verify")}[action]
    return httpx.request(
        method,
        f"{given['service']}/v1/subjects/{given['subject']}/{path}",
        files={"images": photo.read_bytes()},
        headers={"Authorization": f"Bearer {given['token']}"},
        timeout=60,
    )


def test_password_and_face_together_open_an_account(
    app: Proxy, people: dict[str, list[Path]]
) -> None:
    own = people[WHO]
    visitor = Visitor(app.url)
    assert visitor.send("POST", "token").status_code == 401
    assert visitor.sign("register", "ann") == 201
    assert Visitor(app.url).sign("register", "ann") == 409
    assert not visitor.is_in
    assert visitor.show(own[0])["action"] == "enroll"
    before = visitor.session
    assert visitor.accepted
    assert visitor.is_in
    assert visitor.session != before

    again = Visitor(app.url)
    assert again.sign("login", "ann", "wrong password") == 401
    assert again.sign("login", "nobody") == 401
    assert again.sign("login", "ann") == 200
    assert not again.is_in
    assert again.show(own[1])["action"] == "verify"
    assert again.accepted
    assert again.is_in
    assert not again.accepted, "what came of a token counts once"


def test_who_knows_the_password_alone_stays_out(app: Proxy, people: dict[str, list[Path]]) -> None:
    owner = Visitor(app.url)
    assert owner.sign("register", "eve") == 201
    owner.show(people[WHO][0])
    assert owner.accepted
    thief = Visitor(app.url)
    assert thief.sign("login", "eve") == 200
    # Without a token, with one that was not used, and with another face.
    assert not thief.accepted
    given = thief.token()
    assert not thief.accepted
    assert given["action"] == "verify"
    thief.show(people[OTHER][0])
    assert not thief.accepted
    assert not thief.is_in
    # The token enrolls nobody.
    refused = use(given, "enroll", people[OTHER][0])
    assert (refused.status_code, refused.json()["error"]["code"]) == (403, "forbidden")


def test_an_older_token_replaces_no_face(app: Proxy, people: dict[str, list[Path]]) -> None:
    """Who knew the password before the first face came holds a token that enrolls."""
    owner, thief = Visitor(app.url), Visitor(app.url)
    assert owner.sign("register", "fay") == 201
    assert thief.sign("login", "fay") == 200
    given = thief.token()
    owner.show(people[WHO][0])
    assert given["action"] == "enroll"
    refused = use(given, "enroll", people[OTHER][0])
    assert refused.json()["error"]["code"] == "enrollment_conflict"
    assert not thief.accepted
    assert owner.accepted


@pytest.mark.parametrize(
    "path",
    [
        "/app.mjs", "/app.py", "/client/", "/client/../package.json", "/client/..%2fpackage.json",
        "/client/%2e%2e/package.json", "/ort/../package.json", "/ort/../../../package.json",
        "/client//etc/passwd",
    ],
)  # fmt: skip
def test_nothing_else_is_served(app: Proxy, path: str) -> None:
    url = httpx.URL(app.url).copy_with(raw_path=path.encode())
    assert httpx.get(url).status_code in (404, 405)


def sign(page: Page, name: str, button: str, password: str = PASSWORD) -> None:
    # A form that is sent before the page's program listens goes nowhere.
    program_ran = "() => customElements.get('veilface-login') !== undefined"
    wait_until(lambda: page.evaluate(program_ran), what="the page's program ran")
    page.get_by_label("Name").fill(name)
    page.get_by_label("Password").fill(password)
    page.get_by_role("button", name=button).click()


def stand_before(page: Page, button: str) -> None:
    page.get_by_role("button", name="Start camera").click()
    page.get_by_role("button", name=button).click()


def told(page: Page) -> Any:
    return expect(page.locator("body > p output"))


def said(page: Page) -> Any:
    return expect(page.locator("veilface-login output"))


def status_of_account(page: Page) -> int:
    status: int = page.evaluate("fetch('/account').then(({ status }) => status)")
    return status


def test_a_browser_sends_passwords_to_the_application_and_templates_to_the_service(
    app: Proxy,
    place: Place,
    browser: Browser,
    camera: FakeCamera,
    people: dict[str, list[Path]],
) -> None:
    """That no face is in what the element sends, tests/web/test_private_mode.py shows."""
    context = browser.new_context()
    try:
        tab = BrowserTab.of(context, app.url + "/")
        page = tab.page
        bearers: set[str] = set()
        attempts: list[Any] = []

        def noted(request: Any) -> None:
            if "authorization" in request.headers:
                bearers.add(request.headers["authorization"].split("_")[0])
            if request.method == "POST" and request.url.endswith("/verify"):
                attempts.append((request.url, request.headers, request.post_data_buffer))

        page.on("request", noted)
        app.forget()
        place.service.forget()
        page.goto(tab.url)
        camera.shows(people[WHO][0])
        sign(page, "zoe", "Register")
        told(page).to_have_text("Now enroll your face")
        stand_before(page, "Enroll")
        told(page).to_have_text("Welcome, zoe")
        assert status_of_account(page) == 200

        sign(page, "zoe", "Sign in", "wrong password")
        told(page).to_have_text("wrong name or password")
        expect(page.locator("veilface-login")).to_have_count(0)

        sign(page, "zoe", "Sign in")
        told(page).to_have_text("Now show your face")
        assert status_of_account(page) == 401
        stand_before(page, "Log in")
        told(page).to_have_text("Welcome, zoe")
        assert status_of_account(page) == 200

        camera.shows(people[OTHER][0])
        sign(page, "zoe", "Sign in")
        stand_before(page, "Log in")
        said(page).to_have_text("Not recognised. Try again.")
        told(page).to_have_text("Now show your face")
        assert status_of_account(page) == 401

        # A new attempt needs a new token.
        (url, headers, body), _ = attempts
        sent_again = {name: headers[name] for name in ("authorization", "content-type")}
        answer = httpx.post(url, content=body, headers=sent_again, timeout=60)
        assert answer.status_code == 401, answer.text
        assert answer.json()["error"]["code"] == "replayed"

        to_app, rest = requests_in(app.sent)
        assert rest == 0
        assert {call: each["members"] for call, each in to_app.items() if "POST" in call} == {
            "POST /register": ["name", "password"],
            "POST /login": ["name", "password"],
            "POST /token": [],
            "POST /face": [],
        }
        to_service, rest = requests_in(place.service.sent)
        assert rest == 0
        for call in ("PUT /v1/subjects/*/enrollment", "POST /v1/subjects/*/verify"):
            assert to_service[call]["members"] == ["template"]
        assert bearers == {"Bearer vft"}
        assert all(url.startswith(place.service.url) for url in tab.strays())
        assert tab.violations() == tab.complaints == []
    finally:
        context.close()
