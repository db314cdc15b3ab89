"""`make release`, with its builders replaced, and the workflows of a forge that call it."""

import hashlib
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
# What the targets that `make release` asks for leave behind.
BUILT = {
    "wheels/veilface-1.10.0-py3-none-any.whl": b"the service",
    "wheels/veilface_client-1.9.0-py3-none-any.whl": b"the client",
    "npm/veilface-client-1.9.0.tgz": b"the client of browsers",
    "sbom.json": b"{}",
}
PROGRAMS = ["basename", "cp", "git", "make", "mkdir", "rm", "sha256sum"]
IMAGE = "veilface-1.10.0-image.tar.gz"


def put(file: Path, text: str) -> None:
    file.parent.mkdir(exist_ok=True)
    file.write_text(f"#!/bin/sh\n{text}\n")
    file.chmod(0o755)


def git(folder: Path, *arguments: str) -> None:
    author = ["-c", "user.name=Anna", "-c", "user.email=anna@example.org"]
    subprocess.run(["git", *author, *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository of its own, with the Makefile and the scripts; root and podman are in it."""
    folder = tmp_path / "checkout"
    shutil.copytree(ROOT / ".ci", folder / ".ci")
    shutil.copy(ROOT / "Makefile", folder)
    (folder / "CHANGELOG.md").write_text(CHANGELOG)
    (folder / "pyproject.toml").write_text('[project]\nversion = "1.10.0"\n')
    (folder / ".gitignore").write_text("dist/\n")
    put(folder / ".ci" / "image", 'printf "the image" > "$1"')
    git(folder, "init")
    git(folder, "add", "--all")
    git(folder, "commit", "--message", "Release")
    tools = tmp_path / "tools"
    put(tools / "podman", "exit 1")
    put(tools / "id", "echo 0")
    for program in PROGRAMS:
        (tools / program).symlink_to(shutil.which(program) or pytest.fail(f"there is no {program}"))
    monkeypatch.setenv("PATH", str(tools))
    return folder


def release(checkout: Path, *settings: str) -> "subprocess.CompletedProcess[str]":
    """Run the target; its builders write what they are asked for, and note that they were."""
    builders = checkout.parent / "builders"
    for name, content in BUILT.items():
        file = builders / "dist" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
    builder = checkout.parent / "tools" / "make-instead"
    put(builder, f'echo "asked: $*"\ncp -R {builders}/dist .')
    command = ["make", "release", f"MAKE={builder}", f"PYTHON={sys.executable}", *settings]
    return subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)


def released(checkout: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (checkout / "dist" / "release").iterdir()}


def test_a_release_is_what_was_built_with_notes_and_checksums(checkout: Path) -> None:
    old = checkout / "dist" / "release" / "veilface-1.1.0-py3-none-any.whl"
    old.parent.mkdir(parents=True)
    old.touch()
    ran = release(checkout)
    assert ran.returncode == 0, ran.stderr
    assert "asked: javascript-package wheels sbom\n" in ran.stdout
    files = released(checkout)
    sums = files.pop("SHA256SUMS").decode().splitlines()
    assert sorted(sums) == sorted(
        f"{hashlib.sha256(content).hexdigest()}  {name}" for name, content in files.items()
    )
    assert files.pop("NOTES.md").decode() == "### Added\n\n- What is released.\n"
    assert files.pop(IMAGE) == b"the image"
    assert files == {Path(name).name: content for name, content in BUILT.items()}


@pytest.mark.parametrize("without", ["root", "podman"])
def test_a_release_has_its_image_unless_it_is_told_not_to(checkout: Path, without: str) -> None:
    tools = checkout.parent / "tools"
    if without == "root":
        put(tools / "id", "echo 1000")
    else:
        (tools / "podman").unlink()
    ran = release(checkout)
    assert ran.returncode != 0
    assert ran.stderr.startswith("no release: its image needs root and podman; IMAGE=no leaves it")
    assert "asked:" not in ran.stdout
    assert not (checkout / "dist" / "release").exists()
    ran = release(checkout, "IMAGE=no")
    assert ran.returncode == 0, ran.stderr
    built = {Path(name).name for name in BUILT}
    assert released(checkout).keys() == {*built, "NOTES.md", "SHA256SUMS"}


def test_an_image_that_fails_fails_the_release(checkout: Path) -> None:
    put(checkout / ".ci" / "image", "exit 1")
    git(checkout, "commit", "--all", "--message", "No image")
    assert release(checkout).returncode != 0
    assert "SHA256SUMS" not in released(checkout)


def undescribed(checkout: Path) -> str:
    (checkout / "CHANGELOG.md").write_text(CHANGELOG.replace("[1.10.0]", "[1.10.1]"))
    git(checkout, "commit", "--all", "--message", "Another version")
    return "CHANGELOG.md says nothing under a heading '## [1.10.0] - YYYY-MM-DD'"


def empty(checkout: Path) -> str:
    text = CHANGELOG.replace("### Added\n\n- What is released.\n", "")
    (checkout / "CHANGELOG.md").write_text(text)
    git(checkout, "commit", "--all", "--message", "Nothing to say")
    return "CHANGELOG.md says nothing under a heading '## [1.10.0] - YYYY-MM-DD'"


def changed(checkout: Path) -> str:
    (checkout / "Makefile").write_text((checkout / "Makefile").read_text() + "\n")
    return "1 files are not as they were committed"


def untracked(checkout: Path) -> str:
    (checkout / "api.py").touch()
    return "1 files are not as they were committed"


def tagged_otherwise(checkout: Path) -> str:
    git(checkout, "tag", "v1.9.0")
    return "the commit is tagged v1.9.0, and pyproject.toml says 1.10.0"


def tagged_twice(checkout: Path) -> str:
    git(checkout, "tag", "v1.10.0")
    return tagged_otherwise(checkout)


@pytest.mark.parametrize(
    "spoil", [undescribed, empty, changed, untracked, tagged_otherwise, tagged_twice]
)
def test_nothing_is_built_where_there_is_nothing_to_release(checkout: Path, spoil: Any) -> None:
    reason = spoil(checkout)
    ran = release(checkout)
    assert ran.returncode != 0
    assert f"no release: {reason}" in ran.stderr
    assert "asked:" not in ran.stdout
    assert not (checkout / "dist" / "release").exists()


def test_the_tag_of_the_version_releases_it(checkout: Path) -> None:
    git(checkout, "tag", "v1.10.0")
    git(checkout, "tag", "vendored")
    assert release(checkout).returncode == 0


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


def test_workflows_call_what_a_person_calls() -> None:
    commands = [
        step["run"].removeprefix("sudo --preserve-env ")
        for file in WORKFLOWS
        for job in yaml.safe_load(file.read_text(encoding="utf-8"))["jobs"].values()
        for step in job.get("steps", [])
        if "run" in step
    ]
    assert ".ci/run" in commands
    assert "make release" in commands
    assert re.search(r"^make workflows$", (ROOT / ".ci" / "run").read_text(), re.M)


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
