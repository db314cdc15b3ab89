"""Imports inside templates/distances go one way, wherever in a file they stand."""

import ast
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "templates" / "distances"
PREFIX = "templates.distances"
MAY = {
    "__init__": {"exact", "metric", "tiles", "torch"},
    "tiles": {"blas", "exact", "kernels", "metric", "threads"},
    "torch": {"exact", "metric"},
    "exact": {"metric"},
    "kernels": {"metric"},
    "metric": set(),
    "blas": set(),
    "threads": set(),
}


def imported(path: Path) -> set[str]:
    """Parts of the package that a file imports."""
    nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    parts = {path.stem for path in FOLDER.glob("*.py")} | {"kernels"}
    inside = {name.split(".")[2] for name in names if name.startswith(f"{PREFIX}.")}
    return {part if part in parts else "__init__" for part in inside}


@pytest.mark.parametrize("part", [*MAY, "space"])
def test_no_import_goes_back(part: str) -> None:
    folders = {"kernels": FOLDER / "kernels", "space": FOLDER.parent / "space"}
    files = sorted(folders[part].glob("*.py")) if part in folders else [FOLDER / f"{part}.py"]
    assert files
    for path in files:
        assert imported(path) - {part} <= MAY.get(part, set()), path


def test_every_file_has_its_place() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} | {"kernels"} == MAY.keys()
