"""The frame of the project: license, version, and the pages for those who change it."""

import ast
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTIONS = [ROOT, ROOT / "clients" / "python"]
PACKAGES = ["api", "attacks", "benchmarks", "clients", "enroll", "models", "templates", "verify"]
FRAME = ["LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "docs/method.md"]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.M))
CI = (ROOT / ".ci" / "run").read_text()


def project(folder: Path) -> dict[str, Any]:
    """The table ``project`` of a distribution."""
    table: dict[str, Any] = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    return table


@pytest.mark.parametrize("folder", DISTRIBUTIONS, ids=lambda folder: str(folder.name))
def test_each_distribution_carries_the_license(folder: Path) -> None:
    stated = project(folder)
    assert (stated["license"], stated["license-files"]) == ("Apache-2.0", ["LICENSE"])
    # PEP 639: an expression stands alone, without the older classifiers.
    assert not [name for name in stated.get("classifiers", []) if name.startswith("License ::")]
    assert "Apache License" in (folder / "LICENSE").read_text()


def test_no_module_states_the_version_again() -> None:
    (version,) = {project(folder)["version"] for folder in DISTRIBUTIONS}
    again = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value == version
    ]
    assert again == []


@pytest.mark.parametrize("page", FRAME)
def test_the_readme_leads_to_the_page(page: str) -> None:
    assert (ROOT / page).is_file()
    assert f"]({page})" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_contributors_are_told_what_exists() -> None:
    block = re.search(r"```sh\n(.*?)```", CONTRIBUTING, re.S)
    assert block is not None
    commands = set(block[1].splitlines()) | set(re.findall(r"`(make [a-z-]+)`", CONTRIBUTING))
    assert {command.removeprefix("make ") for command in commands} <= TARGETS
    tests = "".join(path.read_text("utf-8") for path in (ROOT / "tests").rglob("*.py"))
    variables = set(re.findall(r"\bVEILFACE_[A-Z_]+", CONTRIBUTING))
    assert variables
    assert [name for name in variables if f'"{name}"' not in tests] == []
