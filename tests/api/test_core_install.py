"""The core install is enough for the service, and for the help of every command."""

import subprocess
import sys
from pathlib import Path

import api
from api.cli.errors import EXTRAS
from tests.patience import PATIENCE_S

ROOT = Path(api.__file__).resolve().parent
OPTIONAL = sorted({"onnx", *(package for packages in EXTRAS.values() for package in packages)})
PROGRAM = """
import importlib, sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in optional:
            raise ModuleNotFoundError(f"{name} is not installed", name=name)

optional = set(sys.argv[1].split(","))
sys.meta_path.insert(0, Absent())
for name in sys.argv[2:]:
    importlib.import_module(name)
assert not optional & {name.partition(".")[0] for name in sys.modules}
"""


def import_without(packages: list[str], *modules: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, ",".join(packages), *modules],
        cwd=ROOT.parent, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip


def test_the_service_and_every_command_are_imported_without_an_extra() -> None:
    modules = [
        ".".join(path.relative_to(ROOT.parent).with_suffix("").parts)
        for path in sorted(ROOT.rglob("*.py"))
        if path.name not in ("__init__.py", "__main__.py")
    ]
    assert {"api.http.app", "api.service.runtime", "api.cli.evaluate", "api.demo.run"} < {*modules}
    done = import_without(OPTIONAL, *modules)
    assert done.returncode == 0, done.stderr


def test_the_block_is_felt() -> None:
    done = import_without(OPTIONAL, "verify.evaluation.figures")
    assert "matplotlib is not installed" in done.stderr
