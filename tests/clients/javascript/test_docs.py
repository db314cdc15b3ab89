"""The programs of docs/javascript.md for Node run, and print what their comments say."""

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.api.deployment import photo, picture
from tests.clients.conftest import Running
from tests.clients.javascript.conftest import PACKAGE, Node
from tests.clients.pages import EXAMPLE, IN_JAVASCRIPT, OF_THE_CLIENT, ROOT, blocks
from veilface_client import Client


@pytest.mark.parametrize("block", [each for each in IN_JAVASCRIPT if "document." not in each])
def test_a_program_prints_what_it_says(
    block: str, node: Node, service: Running, tmp_path: Path
) -> None:
    with Client(service.url, service.deployment.token) as client:
        for subject in list(client.subjects()):
            client.erase(subject.subject_id)
    for shot in range(1, 6):
        (tmp_path / f"anna{shot}.jpg").write_bytes(photo(1, shot))
        (tmp_path / f"emil{shot}.rgb").write_bytes(picture(9, shot).tobytes())
    (tmp_path / "embedder.onnx").symlink_to(service.pack / "tiny.onnx")
    (tmp_path / "node_modules").mkdir()
    (tmp_path / "node_modules" / "veilface-client").symlink_to(PACKAGE)
    (tmp_path / "node_modules" / "onnxruntime-web").symlink_to(
        PACKAGE / "node_modules" / "onnxruntime-web"
    )
    assert EXAMPLE in block
    (tmp_path / "program.mjs").write_text(block.replace(EXAMPLE, service.url))
    done = subprocess.run(
        ["node", "program.mjs"],
        cwd=tmp_path,
        env={"PATH": os.environ["PATH"], "VEILFACE_API_KEY": service.deployment.token},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == re.findall(r"^.*console\.log.*; // (.*)$", block, re.M)


def test_the_page_of_the_readme_is_that_of_the_docs() -> None:
    assert blocks("clients/javascript/README.md", "js") == [OF_THE_CLIENT]


def test_versions_of_both_clients_are_one() -> None:
    (python,) = re.findall(
        r'^version = "(.*)"$', (ROOT / "clients/python/pyproject.toml").read_text(), re.M
    )
    assert f'"version": "{python}"' in (PACKAGE / "package.json").read_text()


def test_the_lock_file_names_no_registry() -> None:
    assert '"resolved"' not in (PACKAGE / "package-lock.json").read_text()
