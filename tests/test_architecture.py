"""A package imports only from the layers below its own (CONTRIBUTING.md)."""

import ast
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
LAYERS = {
    "templates": 1,
    "models": 1,
    "enroll": 2,
    "verify": 2,
    "attacks": 3,
    "api": 4,
    "veilface": 5,
}


def imported_packages(source: str) -> set[str]:
    """Packages that a file imports, wherever in the file the import stands."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            # A relative import stays inside its package: level 1 and more.
            names.add("" if node.level else node.module or "")
        elif (
            isinstance(node, ast.Call)
            and getattr(node.func, "attr", getattr(node.func, "id", "")) in _DYNAMIC
            and node.args
            and isinstance(node.args[0], ast.Constant)
        ):
            names.add(str(node.args[0].value))
    return {name.split(".")[0] for name in names} & LAYERS.keys()


_DYNAMIC = {"import_module", "__import__"}


def forbidden(package: str, imported: set[str]) -> set[str]:
    """Imports of a package that point up or sideways."""
    return {other for other in imported - {package} if LAYERS[other] >= LAYERS[package]}


@pytest.mark.parametrize("package", LAYERS)
def test_no_import_points_up_or_sideways(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"the package {package} is gone"
    wrong = {
        str(path.relative_to(ROOT)): sorted(imports)
        for path in files
        if (imports := forbidden(package, imported_packages(path.read_text(encoding="utf-8"))))
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
        r"""\.write_(text|bytes)\(|savefig\((?!png|svg)|open\([^)]*["'][wxa]b?["']"""
    )
    wrong = {
        str(path.relative_to(ROOT)): lines
        for path in modules
        if (
            lines := [line for line in path.read_text("utf-8").splitlines() if writing.search(line)]
        )
    }
    assert not wrong


@pytest.mark.parametrize("folder", ["templates", "models", "enroll", "api/http", "api/service"])
def test_what_a_service_never_uses_is_imported_where_it_is_used(folder: str) -> None:
    """Each command, and each worker, would wait for it."""
    slow = {"scipy.fft", "scipy.special", "scipy.stats", "rich", "rich.console", "rich.progress"}
    slow |= {"matplotlib"}
    for path in (ROOT / folder).rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.Import):
                assert not slow & {alias.name for alias in node.names}, path
            elif isinstance(node, ast.ImportFrom):
                assert node.module not in slow, path


@pytest.mark.parametrize("package", LAYERS)
def test_packages_import_neither_tests_nor_the_layer_of_http(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
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
        rest = modules - LAYERS.keys() - set(sys.stdlib_module_names) - {"", "__future__"}
        if package != "api":
            assert not rest & {"fastapi", "starlette", "typer", "uvicorn"}, path


def test_the_layers_are_those_of_the_page() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d) \| (.+?) \|", text, flags=re.MULTILINE)
    stated = {name: int(layer) for layer, names in rows for name in re.findall(r"`(\w+)/`", names)}
    assert stated == LAYERS
