"""`veilface models`: from an address that the user names to a pack that can be used."""

import contextlib
import hashlib
import io
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from api.cli.pack_download import shown
from models.demo import DEMO_NOTICE, build_demo_pack, demo_model_sha256
from models.known_packs import KNOWN_PACKS
from tests.api.cli.conftest import Ran, World, run
from tests.ports import free_port


class Site:
    """An address where files lie; what it was asked for is kept."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.moved: dict[str, str] = {}
        self.headers: dict[str, str] = {}
        self.asked: list[str] = []
        site = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                path = self.path.partition("?")[0]
                site.asked.append(path)
                if path in site.moved:
                    self.send_response(302)
                    self.send_header("Location", site.moved[path])
                    self.end_headers()
                    return
                data = site.files.get(path)
                self.send_response(404 if data is None else 200)
                for name, value in site.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(data or b"")))
                self.end_headers()
                with contextlib.suppress(ConnectionError):  # who asked may have gone
                    self.wfile.write(data or b"")

            def log_message(self, *_: object) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}"


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Site]:
    monkeypatch.chdir(tmp_path)
    for variable in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(variable, raising=False)
    made = Site()
    thread = threading.Thread(target=made.server.serve_forever, args=(0.05,))
    thread.start()
    yield made
    made.server.shutdown()
    thread.join()
    made.server.server_close()


@pytest.fixture
def graph(tmp_path: Path) -> bytes:
    """The embedder of the demo, as somebody's weights."""
    return next(build_demo_pack(tmp_path / "demo").glob("*.onnx")).read_bytes()


def zipped(entries: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return buffer.getvalue()


def fetch(name: str, *more: str) -> Ran:
    return run("models", "fetch", name, *more, "--accept-licence")


def nothing_is_left() -> bool:
    return not Path("packs").exists() or list(Path("packs").iterdir()) == []


def test_an_archive_becomes_a_pack(site: Site, graph: bytes) -> None:
    archive = zipped({"mine/rec.onnx": graph, "mine/README": b"hello"})
    site.files["/mine.zip"] = archive
    site.moved["/latest"] = "/mine.zip"
    ran = fetch("mine", "--from", f"{site.url}/latest?token=not-to-be-shown", "--json")
    assert ran.status == 0, ran.stderr
    assert site.asked == ["/latest", "/mine.zip"]
    assert ran.json["sha256"] == {f"{site.url}/latest": hashlib.sha256(archive).hexdigest()}
    assert "not-to-be-shown" not in ran.stdout + ran.stderr
    assert "Left in the archive: 1 files." in ran.stderr
    assert [file.name for file in Path("packs/mine").iterdir()] == ["rec.onnx"]
    assert list(Path("packs").iterdir()) == [Path("packs/mine")]
    assert run("models", "inspect", "packs/mine").status == 0
    again = fetch("mine", "--from", f"{site.url}/mine.zip")
    assert (again.status, "is there already" in again.stderr) == (1, True)


def test_a_pin_is_held(site: Site, graph: bytes) -> None:
    site.files["/rec.onnx"] = graph
    right, wrong = hashlib.sha256(graph).hexdigest(), "0" * 64
    refused = fetch("mine", "--from", f"{site.url}/rec.onnx", "--sha256", wrong)
    assert refused.status == 1
    assert f"has SHA-256 {right}, and not the one of --sha256" in refused.stderr
    assert nothing_is_left()
    assert fetch("mine", "--from", f"{site.url}/rec.onnx", "--sha256", right.upper()).status == 0
    assert fetch("x", "--from", "a.onnx", "--sha256", wrong, "--sha256", wrong).status == 2


def test_what_cannot_be_used_is_not_kept(site: Site, graph: bytes) -> None:
    site.files["/broken.onnx"] = graph[:1000]
    site.files["/page.onnx"] = b"<html>sign in</html>"
    site.files["/evil.zip"] = zipped({"rec\u202e.onnx": graph})
    site.files["/text"] = b"hello"
    for path in ("broken.onnx", "page.onnx", "evil.zip", "text", "absent.zip"):
        refused = fetch("mine", "--from", f"{site.url}/{path}")
        assert refused.status == 1, path
        assert refused.stderr.splitlines()[-1].startswith("error: ")
        assert "defect" not in refused.stderr
        assert nothing_is_left()
    two = ("--from", f"{site.url}/broken.onnx", "--from", f"{site.url}/broken.onnx")
    assert "two sources have a file of the name broken.onnx" in fetch("mine", *two).stderr


def test_an_answer_of_somebody_hostile_is_refused(site: Site, graph: bytes) -> None:
    for address in ("http://[::1/rec.onnx", "http://me:secret@a\x1b[2J/rec.onnx", "https://xn--/x"):
        assert_refused(fetch("mine", "--from", address), "cannot be fetched")
    for name in ("%1b[2J.onnx", "a%00.onnx"):
        site.files[f"/{name}"] = graph
        assert_refused(fetch("mine", "--from", f"{site.url}/{name}"), "neither a zip archive nor")
    for number, place in enumerate(("http://[::1/", "https://xn--/", "ftp://x/", "/0")):
        site.moved[f"/{number}"] = place
        assert_refused(fetch("mine", "--from", f"{site.url}/{number}"), "cannot be fetched")
    site.files["/a.onnx"] = graph
    site.headers["Content-Encoding"] = "gzip"
    address = f"{site.url}/a.onnx"
    assert_refused(fetch("mine", "--from", address), "cannot be fetched (DecodingError)")


def assert_refused(ran: Ran, reason: str) -> None:
    assert ran.status == 1
    assert ran.stderr.splitlines()[-1].startswith("error: ")
    assert reason in ran.stderr
    assert "defect" not in ran.stderr
    assert "secret" not in ran.stderr
    assert ran.stderr.replace("\n", "").isprintable()
    assert nothing_is_left()


@pytest.mark.parametrize("place", ["address", "file"])
def test_a_large_file_is_refused(
    site: Site, graph: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    monkeypatch.setattr("api.cli.pack_download.MAX_FILE_BYTES", len(graph) - 1)
    site.files["/a.onnx"] = graph
    (tmp_path / "a.onnx").write_bytes(graph)
    source = f"{site.url}/a.onnx" if place == "address" else str(tmp_path / "a.onnx")
    assert_refused(fetch("mine", "--from", source), "is larger than")


def test_without_a_network_a_file_does_as_well(site: Site, graph: bytes, tmp_path: Path) -> None:
    refused = fetch("mine", "--from", f"http://127.0.0.1:{free_port()}/rec.onnx")
    assert refused.status == 1
    assert "cannot be fetched (ConnectError)" in refused.stderr
    assert "--from FILE" in refused.stderr
    (tmp_path / "rec.onnx").write_bytes(graph)
    assert fetch("mine", "--from", str(tmp_path / "rec.onnx")).status == 0
    assert (tmp_path / "rec.onnx").read_bytes() == graph
    missing = fetch("other", "--from", "missing.zip")
    assert "missing.zip is neither an http(s) address nor a file" in missing.stderr


def test_the_licence_is_asked_for(site: Site, graph: bytes) -> None:
    site.files["/rec.onnx"] = graph
    known = KNOWN_PACKS["buffalo_l"]
    refused = run("models", "fetch", "buffalo_l", "--from", f"{site.url}/rec.onnx")
    assert refused.status == 2
    assert f"{known.contents}; licence: non-commercial research only" in refused.stderr
    assert "--accept-licence" in refused.stderr
    assert site.asked == []


def test_plain_http_is_for_this_machine_or_a_pin(
    site: Site, graph: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if 127.0.0.1 were any other host."""
    monkeypatch.setattr("api.cli.pack_download.LOOPBACK", frozenset())
    site.files["/rec.onnx"] = graph
    address = f"{site.url}/rec.onnx"
    refused = fetch("mine", "--from", address)
    assert (refused.status, "leads over plain http" in refused.stderr) == (1, True)
    assert nothing_is_left()
    pin = hashlib.sha256(graph).hexdigest()
    assert fetch("mine", "--from", address, "--sha256", pin).status == 0


def test_secrets_of_an_address_are_not_shown() -> None:
    assert shown("https://me:secret@example.org/a.zip?key=1#x") == "https://example.org/a.zip"
    assert fetch("../up", "--from", "x").status == 2


def test_the_demo_pack_is_usable_and_says_what_it_is(world: World) -> None:
    ran = run("models", "inspect", world.pack)
    assert ran.status == 0
    assert "embedder" in ran.stdout
    assert DEMO_NOTICE in ran.stderr
    told = run("models", "inspect", world.pack, "--json").json
    assert told["usable"]
    assert told["graphs"][0]["sha256"] == demo_model_sha256()
    assert (told["pack"]["n"], told["pack"]["detector"]) == (256, None)


def test_a_pack_without_an_embedder_is_status_1(mbf_pack_dir: Path, tmp_path: Path) -> None:
    detector = next(path for path in mbf_pack_dir.glob("*.onnx") if "det" in path.name)
    (tmp_path / detector.name).symlink_to(detector)
    ran = run("models", "inspect", tmp_path, "--json")
    assert (ran.status, ran.json["usable"]) == (1, False)
    assert "no embedder" in ran.json["reason"]
    assert ran.json["graphs"][0]["role"].startswith("scrfd")
