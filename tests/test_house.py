"""The house: a room imports only from the floors below it (docs/architecture.md)."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
FLOORS = {"templates": 1, "models": 1, "enroll": 2, "verify": 2, "attacks": 3, "api": 4}


def imported_rooms(source: str) -> set[str]:
    """Rooms that a file imports, wherever in the file the import stands."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays inside its room: level 1 and more below a top-level package.
            names.add("" if node.level else node.module or "")
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", "")) in _DYNAMIC
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            names.add(str(node.args[0].value))
    return {name.split(".")[0] for name in names} & FLOORS.keys()


_DYNAMIC = {"import_module", "__import__"}


def forbidden(room: str, imported: set[str]) -> set[str]:
    """Arrows from a room that go up or sideways."""
    return {other for other in imported - {room} if FLOORS[other] >= FLOORS[room]}


@pytest.mark.parametrize("room", FLOORS)
def test_no_arrow_goes_up_or_sideways(room: str) -> None:
    files = sorted((ROOT / room).rglob("*.py"))
    assert files, f"the room {room} is gone"
    wrong = {
        str(path.relative_to(ROOT)): sorted(arrows)
        for path in files
        if (arrows := forbidden(room, imported_rooms(path.read_text(encoding="utf-8"))))
    }
    assert not wrong


def test_commands_write_no_file_where_a_link_of_somebody_else_leads() -> None:
    """What a command writes goes through ``templates/keys/private_file.py``."""
    modules = [
        path
        for folder in ("api/cli", "enroll", "verify", "attacks", "templates/decoys")
        for path in (ROOT / folder).rglob("*.py")
    ]
    writing = re.compile(
        r"""\.write_(text|bytes)\(|\.mkdir\(|savefig\((?!png|svg)|open\([^)]*["'][wxa]b?["']"""
    )
    wrong = {
        str(path.relative_to(ROOT)): lines
        for path in modules
        if (
            lines := [line for line in path.read_text("utf-8").splitlines() if writing.search(line)]
        )
    }
    assert not wrong


@pytest.mark.parametrize("room", FLOORS)
def test_rooms_are_of_use_below_the_tests_only(room: str) -> None:
    for path in (ROOT / room).rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        modules = {
            alias.name.split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.Import)
            for alias in node.names
        } | {
            (node.module or "").split(".")[0]
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and not node.level
        }
        assert not modules & {"tests", "benchmarks", "pytest", "hypothesis"}, path
        rest = modules - FLOORS.keys() - set(sys.stdlib_module_names) - {"", "__future__"}
        if room != "api":
            assert not rest & {"fastapi", "starlette", "typer", "uvicorn"}, path


def test_every_package_has_its_floor() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests", "benchmarks"}
    assert packages == set(FLOORS)


def test_the_floors_are_those_of_the_architecture() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d) \| (.+?) \|", text, flags=re.MULTILINE)
    stated = {room: int(floor) for floor, rooms in rows for room in re.findall(r"`(\w+)/`", rooms)}
    assert stated == FLOORS


@pytest.mark.parametrize(
    ("room", "line", "arrows"),
    [
        ("templates", "import models", {"models"}),
        ("templates", "from models.pack import ModelPack", {"models"}),
        ("templates", "from templates.errors import VeilfaceError", set()),
        ("enroll", "from verify.metrics import wilson", {"verify"}),
        ("enroll", "from templates import wire", set()),
        ("verify", "def f():\n    import api.settings", {"api"}),
        ("verify", "import importlib\nimportlib.import_module('api.http.app')", {"api"}),
        ("attacks", "import enroll, api", {"api"}),
        ("api", "import attacks, enroll, verify, models, templates", set()),
        ("models", "import numpy.api", set()),
    ],
)
def test_the_check_sees_an_arrow(room: str, line: str, arrows: set[str]) -> None:
    assert forbidden(room, imported_rooms(line)) == arrows
