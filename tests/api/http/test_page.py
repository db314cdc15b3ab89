"""The page's files: where they are served, with which headers, and where they are not."""

import gzip
import re
from pathlib import Path
from typing import Any

import pytest

from api.http.app import create_app
from api.http.routes import page
from api.http.routes.page import WEB
from api.settings import Settings
from tests.api.client import Client
from tests.api.deployment import bearer, deploy
from tests.api.shapes import assert_error

POLICY = {
    "default-src": "'none'",
    "script-src": "'self'",
    "style-src": "'self'",
    "img-src": "'self' blob:",
    "connect-src": "'self'",
    "frame-ancestors": "'none'",
    "base-uri": "'none'",
    "form-action": "'none'",
    "require-trusted-types-for": "'script'",
    "trusted-types": "'none'",
}
MOST_BYTES = 120 * 1024
MOST_BYTES_OF_PRIVATE_MODE = 14 * 1024
"""Of the module that is fetched only where the service serves its pack."""
MARKUP = re.compile(
    r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function|style="
)


def test_the_page_and_its_policy(client: Client) -> None:
    answer = client.get("/", headers={"Authorization": ""})
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert policy_of(client) == POLICY
    assert "camera=(self)" in answer.headers["permissions-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["x-request-id"]
    assert 'data-demo="no"' in answer.text


def policy_of(client: Client) -> dict[str, str]:
    """The page's Content-Security-Policy, by directive."""
    stated = client.get("/").headers["content-security-policy"]
    return dict(part.strip().split(" ", 1) for part in stated.split(";"))


def test_everything_that_the_page_names_is_served(client: Client) -> None:
    seen: set[str] = set()
    waiting = ["/"]
    while waiting:
        path = waiting.pop()
        seen.add(path)
        answer = client.get(path)
        assert answer.status_code == 200, path
        kind = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8",
                ".svg": "image/svg+xml"}.get(Path(path).suffix)  # fmt: skip
        assert kind is None or answer.headers["content-type"] == kind
        # Relative, so that they are right below a proxy's prefix too.
        links = re.findall(r'(?:href|src)="([^"#]+)"', answer.text) if path == "/" else ()
        named = {f"/{link}" for link in links}
        imported = re.findall(r'(?:from |import\()"\./([^"/]+)"', answer.text)
        named |= {f"/assets/{name}" for name in imported}
        waiting += sorted(named - seen)
    assert seen == {"/", "/docs"} | {
        f"/assets/{file.name}" for file in _files() if file.name != "index.html"
    }


def _files() -> list[Path]:
    """The page's own files, without what `make javascript` builds."""
    return [path for path in WEB.iterdir() if path.is_file()]


def test_the_files_are_small_and_name_nobody_else() -> None:
    texts = {file.name: file.read_text(encoding="utf-8") for file in _files()}
    sizes = {name: len(text.encode()) for name, text in texts.items()}
    assert sizes["private.js"] <= MOST_BYTES_OF_PRIVATE_MODE
    assert sum(sizes.values()) - sizes["private.js"] <= MOST_BYTES
    # By one import, which is not made unless the pack is served.
    assert [name for name, text in texts.items() if "private.js" in text] == ["service.js"]
    for name, text in texts.items():
        foreign = re.findall(r"https?://[^\s\"')]+", text)
        assert [url for url in foreign if not url.startswith("http://www.w3.org/")] == [], name
        # No text becomes markup or code, and no style stands in the markup.
        assert not MARKUP.search(text), name


def test_a_browsers_copy_is_asked_for_again_and_not_sent_again(client: Client) -> None:
    for path in ("/", "/assets/main.js", "/assets/page.css"):
        first = client.get(path)
        assert first.headers["cache-control"] == "no-cache"
        etag = first.headers["etag"]
        again = client.get(path, headers={"If-None-Match": f'"other", W/{etag}'})
        assert (again.status_code, again.content) == (304, b"")
        assert again.headers["etag"] == etag
        assert client.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
        head = client.request("HEAD", path)
        assert (head.status_code, head.content) == (200, b"")


@pytest.mark.parametrize(
    "path",
    ["/assets/", "/assets/index.html", "/assets/none.js", "/assets/../app.py", "/assets/%00",
     "/index.html", "/favicon.ico", "/demo/people", "/demo/people/person-1/0.png"],
)  # fmt: skip
def test_what_is_no_file_of_the_page_is_the_contracts_404(client: Client, path: str) -> None:
    answer = client.get(path)
    assert_error(answer, 404, "not_found")
    assert answer.headers["cache-control"] == "no-store"
    assert answer.headers["content-security-policy"] == "default-src 'none'; frame-ancestors 'none'"
    assert "permissions-policy" not in answer.headers


def raw(client: Client, path: str) -> int:
    """Ask for a path that nobody has normalised; return the status."""
    scope = {
        "type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "GET",
        "scheme": "http", "path": path, "raw_path": path.encode(), "root_path": "",
        "query_string": b"", "headers": [(b"host", b"test")], "client": ("127.0.0.1", 1),
        "server": ("test", 80), "state": {},
    }  # fmt: skip
    statuses: list[int] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"", "more_body": False}

    async def send(message: Any) -> None:
        if message["type"] == "http.response.start":
            statuses.append(message["status"])

    async def ask() -> None:
        await client.app(scope, receive, send)

    client._portal.call(ask)
    return statuses[0]


def _serving_its_pack(folder: Path, **changes: Any) -> Client:
    deployment = deploy(folder, **{"serve_pack": True, **changes})
    return Client(create_app(deployment.settings), headers=bearer(deployment.token))


def _put_client(folder: Path) -> None:
    """As `make javascript` does: compressed, and beside it a text that is not served."""
    folder.mkdir()
    (folder / "client.js.gz").write_bytes(gzip.compress(b"export const client = 1;"))
    (folder / "runtime.mjs.gz").write_bytes(gzip.compress(b"export const runtime = 1;"))
    (folder / "runtime.wasm.gz").write_bytes(gzip.compress(b"\0asm"))
    (folder / "runtime.LICENSE").write_text("MIT")


def test_private_mode_is_offered_where_the_pack_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _put_client(tmp_path / "client")
    monkeypatch.setattr(page, "CLIENT", tmp_path / "client")
    with _serving_its_pack(tmp_path / "served") as client:
        assert 'data-client="yes" data-private="yes"' in client.get("/").text
        assert policy_of(client) == POLICY | {"script-src": "'self' 'wasm-unsafe-eval'"}
        for name, kind, content in (
            ("client.js", "text/javascript; charset=utf-8", b"export const client = 1;"),
            ("runtime.mjs", "text/javascript; charset=utf-8", b"export const runtime = 1;"),
            ("runtime.wasm", "application/wasm", b"\0asm"),
        ):
            file = client.get(f"/assets/client/{name}")
            assert (file.status_code, file.content) == (200, content)
            assert file.headers["content-type"] == kind
            again = client.get(
                f"/assets/client/{name}", headers={"If-None-Match": file.headers["etag"]}
            )
            assert again.status_code == 304
        for absent in ("runtime.LICENSE", "client.js.gz", "../main.js", "none.js"):
            assert raw(client, f"/assets/client/{absent}") == 404


def test_without_the_built_client_the_page_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "CLIENT", tmp_path / "absent")
    with _serving_its_pack(tmp_path / "served") as client:
        assert 'data-client="no" data-private="yes"' in client.get("/").text
        assert policy_of(client) == POLICY
        assert_error(client.get("/assets/client/client.js"), 404, "not_found")


@pytest.mark.parametrize("changes", [{"serve_pack": False}, {"demo": True}])
def test_elsewhere_the_page_has_the_client_for_its_passkeys_alone(
    changes: dict[str, bool], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the demo, what tells a cartoon face from another picture is in no graph."""
    _put_client(tmp_path / "client")
    monkeypatch.setattr(page, "CLIENT", tmp_path / "client")
    with _serving_its_pack(tmp_path / "served", **changes) as client:
        assert 'data-client="yes" data-private="no"' in client.get("/").text
        assert policy_of(client) == POLICY
        assert client.get("/assets/client/client.js").status_code == 200
        assert_error(client.get("/assets/client/runtime.wasm"), 404, "not_found")


def test_the_page_can_be_switched_off(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, web_page=False)
    with Client(create_app(deployment.settings), headers=bearer(deployment.token)) as client:
        for path in ("/", "/assets/main.js", "/assets/page.css", "/demo/people"):
            assert_error(client.get(path), 404, "not_found")
        assert client.get("/v1/key").status_code == 200


def test_the_page_is_no_part_of_the_contract() -> None:
    paths = create_app(Settings(demo=True)).openapi()["paths"]
    assert not [path for path in paths if path == "/" or path.startswith(("/assets", "/demo"))]


def test_the_demo_is_marked_before_anybody_signs_in(tmp_path: Path) -> None:
    deployment = deploy(tmp_path, demo=True)
    with Client(create_app(deployment.settings)) as client:
        page = client.get("/")
        assert 'data-demo="yes"' in page.text
        assert "demo model: not for authentication" in page.text
        assert "person-101" in client.get("/demo/people").json()["people"]
        assert client.get("/demo/people/person-101/4.png").headers["content-type"] == "image/png"
        assert_error(client.get("/demo/people/person-9/0.png"), 404, "not_found")
        assert_error(client.get("/demo/people/person-1/5.png"), 404, "not_found")
        assert_error(client.get("/demo/people/100000/0.png"), 404, "not_found")
