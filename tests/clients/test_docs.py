"""Every snippet of the client's pages runs, and prints what its comments say."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.api.deployment import photo
from tests.clients.conftest import VEILFACE, Running
from tests.clients.pages import EXAMPLE, ROOT, blocks
from veilface_client import Client

CLIENT, DISTRIBUTION = PAGES = ("docs/python.md", "clients/python/README.md")
PYTHON = [
    pytest.param(block, id=f"{page}-{number}")
    for page in PAGES
    for number, block in enumerate(blocks(page, "python"))
]


@pytest.fixture
def newcomer(service: Running, token: str, tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """A folder with six photos and a pack, on a service where nobody is enrolled."""
    with Client(service.url, token) as client:
        for subject in list(client.subjects()):
            client.erase(subject.subject_id)
    for shot in range(6):
        (tmp_path / f"anna{shot + 1}.jpg").write_bytes(photo(1, shot))
    (tmp_path / "buffalo_l").symlink_to(service.pack)
    path = f"{VEILFACE.parent}:{os.environ['PATH']}"
    return tmp_path, {"PATH": path, "HOME": str(tmp_path), "VEILFACE_API_KEY": token}


@pytest.mark.parametrize("block", PYTHON)
def test_a_snippet_prints_what_it_says(
    block: str, service: Running, newcomer: tuple[Path, dict[str, str]]
) -> None:
    folder, env = newcomer
    assert EXAMPLE in block
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", block.replace(EXAMPLE, service.url)],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    expected = re.findall(r"^ *print\(.*\)  # (.*)$", block, flags=re.MULTILINE)
    assert expected, "a snippet that shows nothing"
    assert done.stdout.splitlines() == expected


def test_the_same_from_the_shell(service: Running, newcomer: tuple[Path, dict[str, str]]) -> None:
    folder, env = newcomer
    install = blocks(CLIENT, "sh")[0]
    script = blocks(CLIENT, "sh")[-1]
    assert install == "pip install ./clients/python\n"
    assert (ROOT / "clients" / "python" / "pyproject.toml").exists()
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script.replace(EXAMPLE, service.url)],
        cwd=folder,
        env=env,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert '"decision":"accept"' in done.stdout.replace(": ", ":")
