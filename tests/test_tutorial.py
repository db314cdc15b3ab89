"""The tutorial's own blocks, in order, in an empty folder; and what it says one should see."""

import os
import re
import signal
import subprocess
import sys
import tarfile
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from tests import test_readme
from tests.patience import PATIENCE_S
from tests.ports import free_port
from tests.test_readme import ROOT, newcomer, wait_until_ready

pytestmark = pytest.mark.long

__all__ = ["newcomer"]

PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
BIN = Path(sys.executable).parent
EXAMPLE_PORT = "8421"
SPAN = re.compile(r"`([^`]+)`")
STRANGERS = 120
# Code spans of what one should see that are names, not output.
NAMES = {".venv", "veilface"}
DOWNLOADS = {"https://ndownloader.figshare.com/files/5976018"}
WEIGHTS = "https://example.org"


@dataclass(frozen=True)
class Block:
    """A fenced block, the prose before it and what one should see after it."""

    before: str
    code: str
    expected: list[str]


def blocks_of(page: str) -> list[Block]:
    parts = re.split(r"^```sh\n(.*?)^```\n", page, flags=re.M | re.S)
    found = []
    for before, code, after in zip(parts[::2], parts[1::2], parts[2::2], strict=False):
        seen = re.findall(r"^\*You should see\*.*?(?=\n\n)", after, flags=re.M | re.S)
        spans = [" ".join(span.split()) for text in seen for span in SPAN.findall(text)]
        found.append(Block(before, code, [span for span in spans if span not in NAMES]))
    return found


BLOCKS = blocks_of(PAGE)


def occurs(span: str, output: str) -> bool:
    """Whether a quoted text is in an output; … stands for anything in one line."""
    pattern = ".*".join(re.escape(part) for part in span.split("…"))
    return re.search(pattern, " ".join(output.split())) is not None


class Terminal:
    """A shell whose folder and variables last from one block to the next."""

    def __init__(self, folder: Path, env: dict[str, str], state: Path) -> None:
        self.env, self.state = env, state
        names = sorted({"PATH"} | set(re.findall(r"^(\w+)=", PAGE, flags=re.M)))
        self._keep = (
            f'\n{{ declare -p {" ".join(names)} || true; printf "cd %q\\n" "$PWD"; }}'
            f' > "{state}" 2>/dev/null\n'
        )
        state.write_text(f"cd '{folder}'\n")

    def type(self, block: str) -> str:
        """Type a block; what the terminal shows."""
        script = f'. "{self.state}"\n{block}{self._keep}'
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", script],
            env=self.env,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=PATIENCE_S,
        )
        assert done.returncode == 0, f"{block}\n{done.stdout}"
        return done.stdout

    def start(self, command: str, log: Path, port: int) -> subprocess.Popen[bytes]:
        """Start a command that stays: the service."""
        with log.open("wb") as out:
            return subprocess.Popen(
                ["bash", "-c", f'. "{self.state}"\nexec {command}'],
                env=self.env | {"VEILFACE_PORT": str(port)},
                stdout=out,
                stderr=subprocess.STDOUT,
            )


def archives(folder: Path, people: Path, fairface: Path) -> Path:
    """What the address of LFW answers: people, of whom some have one photo only."""
    folder.mkdir()
    with tarfile.open(folder / "5976018", "w:gz", compresslevel=1) as archive:
        for photo in sorted(people.glob("*/*.jpg")):
            archive.add(photo, f"lfw/{photo.parent.name}/{photo.name}")
        strangers = sorted((fairface / "train").glob("*.jpg"))[:STRANGERS]
        for index, photo in enumerate(strangers):
            archive.add(photo, f"lfw/Stranger_{index}/Stranger_{index}_0001.jpg")
    return folder


def test_the_page_says_what_one_should_see_after_every_block() -> None:
    silent = [block.code.split("\n")[0] for block in BLOCKS if not block.expected]
    assert silent == []


def test_make_demo_is_the_command_that_stands_in_for_it() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^demo: .*\n\t\$\(VENV\)/veilface demo\n\n", makefile, flags=re.M)
    assert re.search(r"^VENV := \.venv/bin$", makefile, flags=re.M)


def test_the_tutorial_from_nothing_to_a_receipt(
    newcomer: tuple[Path, dict[str, str]],
    shared_data: Path,
    fairface: Path,
    lfw_photos: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, env = newcomer
    env["PATH"] = os.pathsep.join(part for part in env["PATH"].split(":") if part != str(BIN))
    port = free_port()
    monkeypatch.setattr(test_readme, "PORT", port)
    away = archives(folder / "away", lfw_photos, fairface)
    weights = shared_data / "packs" / "mobilefacenet128_apache"
    replaced = {
        "git clone https://example.org/veilface.git": "mkdir veilface; mv .venv veilface/.venv",
        "make demo": "PATH=.venv/bin:$PATH; . .venv/bin/activate; veilface demo",
        **{address: f"file://{away}/{Path(address).name}" for address in DOWNLOADS},
        WEIGHTS: str(weights),
        f":{EXAMPLE_PORT}": f":{port}",
    }
    assert all(text in PAGE for text in replaced)
    clone = folder / "veilface"
    terminals = {
        "first": Terminal(folder, env, folder / "first"),
        "second": Terminal(clone, env, folder / "second"),
    }
    service: subprocess.Popen[bytes] | None = None
    terminal = ""
    try:
        for number, block in enumerate(BLOCKS):
            if service is not None and "Ctrl-C in the first terminal" in block.before:
                try_drawn_people(f"http://127.0.0.1:{port}", clone / "demo-data" / "api-key")
                stop(service)
                service = None
            for named in re.findall(r"\*\*(first|second) terminal\*\*", block.before):
                terminal = named
            code = block.code
            for old, new in replaced.items():
                code = code.replace(old, new)
            log = folder / f"{number}.log"
            *lines, last = code.rstrip("\n").split("\n")
            if last.startswith("veilface serve") and "--check" not in last:
                output = terminals[terminal].type("\n".join([*lines, ""]))
                service = terminals[terminal].start(last, log, port)
                wait_until_ready(service)  # type: ignore[arg-type]
                output += log.read_text()
            else:
                output = terminals[terminal].type(code)
            expected = [span.replace(f":{EXAMPLE_PORT}", f":{port}") for span in block.expected]
            assert [span for span in expected if not occurs(span, output)] == [], output
        assert service is not None
        stop(service)
    finally:
        if service is not None and service.poll() is None:
            stop(service)


def try_drawn_people(url: str, key: Path) -> None:
    """What the tutorial has one do in the browser, by the calls that the page makes."""
    with httpx.Client(base_url=url, timeout=PATIENCE_S) as page:
        assert "demo model: not for authentication" in page.get("/").text
        page.headers["Authorization"] = f"Bearer {key.read_text().strip()}"
        decisions = {
            person: {
                page.post(
                    "/v1/subjects/person-2/verify",
                    files={"image": page.get(f"/demo/people/{person}/{shot}.png").content},
                )
                .json()
                .get("decision", "locked")
                for shot in (3, 4)
            }
            for person in ("person-2", "person-3", "person-4")
        }
    assert "accept" in decisions["person-2"]
    # One stranger in a few thousand is accepted by chance, on both of his photos at once; a third
    # stranger would be locked out.
    assert "reject" in decisions["person-3"] | decisions["person-4"]


def stop(service: subprocess.Popen[bytes]) -> None:
    """Ctrl-C."""
    service.send_signal(signal.SIGINT)
    assert service.wait(timeout=PATIENCE_S) in (0, -signal.SIGINT, 130)
