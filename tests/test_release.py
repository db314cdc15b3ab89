"""The notes of a release, and the workflows of a forge that make one."""

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parent.parent
TEST = ".github/workflows/test.yml"
WORKFLOWS = sorted((ROOT / ".github" / "workflows").iterdir())
CHANGELOG = """\
# Changelog

## [Unreleased]

- Not yet.

## [1.10.0] - 2026-11-24

### Added

- What is released.

## [1.1.0] - 2026-10-01

- What was released before.
"""


def git(folder: Path, *arguments: str) -> None:
    author = ["-c", "user.name=Anna", "-c", "user.email=anna@example.org"]
    subprocess.run(["git", *author, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository of its own, with the script."""
    (tmp_path / ".ci").mkdir()
    shutil.copy(ROOT / ".ci" / "release_notes.py", tmp_path / ".ci")
    (tmp_path / "CHANGELOG.md").write_text(CHANGELOG)
    (tmp_path / "pyproject.toml").write_text('[project]\nversion = "1.10.0"\n')
    git(tmp_path, "init")
    git(tmp_path, "add", "--all")
    git(tmp_path, "commit", "--message", "Release")
    return tmp_path


def notes(checkout: Path) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, checkout / ".ci" / "release_notes.py"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("tags", [(), ("v1.10.0", "vendored")])
def test_the_notes_are_those_of_the_version(checkout: Path, tags: tuple[str, ...]) -> None:
    for tag in tags:
        git(checkout, "tag", tag)
    written = notes(checkout)
    assert (written.returncode, written.stderr) == (0, "")
    assert written.stdout == "### Added\n\n- What is released.\n"


def undescribed(checkout: Path) -> str:
    (checkout / "CHANGELOG.md").write_text(CHANGELOG.replace("[1.10.0]", "[1.10.1]"))
    git(checkout, "commit", "--all", "--message", "Another version")
    return "CHANGELOG.md says nothing under a heading '## [1.10.0] - YYYY-MM-DD'"


def changed(checkout: Path) -> str:
    (checkout / "pyproject.toml").write_text('[project]\nversion = "1.10.1"\n')
    return "1 files are not as they were committed"


@pytest.mark.parametrize("spoil", [undescribed, changed])
def test_there_are_no_notes_where_there_is_nothing_to_release(checkout: Path, spoil: Any) -> None:
    reason = spoil(checkout)
    written = notes(checkout)
    assert (written.returncode, written.stdout) == (1, "")
    assert written.stderr.startswith(f"no release: {reason}")


@pytest.mark.parametrize("file", WORKFLOWS, ids=lambda file: str(file.name))
def test_workflows_are_pinned_and_may_do_little(file: Path) -> None:
    text = file.read_text(encoding="utf-8")
    used = [each for each in re.findall(r"uses: (.*)", text) if each != f"$/{TEST}"]
    assert used
    assert all(re.fullmatch(r"[\w/-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", each) for each in used)
    workflow = yaml.safe_load(text)
    assert workflow["permissions"] == {}
    for job in workflow["jobs"].values():
        commands = "\n".join(step.get("run", "") for step in job.get("steps", []))
        builds = ".ci/run" in commands or "make " in commands or "uses" in job
        assert job["permissions"] == {"contents": "read" if builds else "write"}


def test_what_is_published_is_a_version_that_was_tested() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "release.yml").read_text())
    jobs = workflow["jobs"]
    assert jobs["test"]["uses"] == f"$/{TEST}"
    assert (jobs["build"]["needs"], jobs["publish"]["needs"]) == ("test", "build")
    # YAML 1.1 reads the key `on` as true.
    (pattern,) = workflow[True]["push"]["tags"]
    assert "workflow_call" in yaml.safe_load((ROOT / TEST).read_text())[True]
    # In a filter of tags, a point is a point, and + and [] are as in an expression.
    tags = ["v1.2.3", "v0.10.0", "vnext", "v1", "v1.2.3-rc1", "v1.2.3.4", "1.2.3"]
    assert [tag for tag in tags if re.fullmatch(pattern.replace(".", r"\."), tag)] == tags[:2]
