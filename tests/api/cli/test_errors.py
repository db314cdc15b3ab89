import re
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from api.cli.errors import EXTRAS, CommandError, Commands, UsageError
from models.errors import PackError
from templates.errors import SealError
from tests.api.cli.conftest import run

SECRET = "0.123456789"


def failing_app(error: Exception) -> typer.Typer:
    app = typer.Typer(cls=Commands, pretty_exceptions_enable=False)

    @app.command()
    def fail() -> None:
        raise error

    @app.command()
    def other() -> None:
        """So that there is a group."""

    return app


@pytest.mark.parametrize(
    ("error", "said", "status"),
    [
        (SealError("the key is another one"), "error: the key is another one", 1),
        (PackError("no embedder here"), "error: no embedder here", 1),
        (CommandError("give photos"), "error: give photos", 1),
        (UsageError("not both"), "error: not both", 2),
        (FileNotFoundError(2, "No such file or directory", "x.jpg"), "x.jpg: No such file", 1),
        (PermissionError(13, "Permission denied", "key"), "key: Permission denied", 1),
        (MemoryError(), "not enough memory", 1),
    ],
)
def test_an_error_is_one_sentence_and_a_status(error, said, status):
    result = CliRunner().invoke(failing_app(error), ["fail"])
    assert result.exit_code == status
    assert said in result.stderr
    assert "Traceback" not in result.stderr
    assert result.stdout == ""


@pytest.mark.parametrize("error", [ValueError(SECRET), MemoryError(), CommandError("no face")])
def test_verify_does_not_fail_with_the_status_of_a_rejection(error):
    app = failing_app(error)
    app.command("verify")(app.registered_commands[0].callback)
    assert CliRunner().invoke(app, ["verify"]).exit_code == 3
    assert CliRunner().invoke(app, ["fail"]).exit_code == 1


ROOT = Path(__file__).resolve().parents[3]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MODULES = {"scikit-learn": "sklearn"}


def names(requirements: list[str]) -> set[str]:
    """Modules that are installed, or the extra that is meant by ``veilface[extra]``."""
    found = {re.match(r"veilface\[.*|[\w-]+", each)[0] for each in requirements}  # type: ignore[index]
    return {MODULES.get(name, name) for name in found}


def test_every_extra_brings_what_its_commands_need():
    stated = PROJECT["optional-dependencies"]
    assert names(stated.pop("all")) == {f"veilface[{','.join(sorted(stated))}]"}
    assert names(stated["cluster"]) == {"distributed", "veilface[evaluate]"}
    stated["cluster"] = ["distributed"]
    assert {extra: names(packages) for extra, packages in stated.items()} == {
        extra: set(packages) for extra, packages in EXTRAS.items()
    }
    assert not names(PROJECT["dependencies"]) & {each for some in EXTRAS.values() for each in some}


@pytest.mark.parametrize(
    ("words", "package", "extra"),
    [
        (("evaluate", "lfw.bin"), "matplotlib", "evaluate"),
        (("evaluate", "lfw.bin"), "numba", "evaluate"),
        (("audit", "templates", "people"), "sklearn", "audit"),
        (("audit", "fairface", "faces"), "matplotlib", "audit"),
        (("db", "upgrade", "--database-url", "postgresql:///faces"), "psycopg", "postgres"),
    ],
)
def test_a_missing_extra_is_named_before_any_work(monkeypatch, words, package, extra):
    monkeypatch.setitem(sys.modules, package, None)
    ran = run(*words)
    assert (ran.status, ran.stdout) == (1, "")
    assert ran.stderr == (
        f'error: {package} is not installed, and needed here: pip install "veilface[{extra}]"\n'
    )


def test_an_unexpected_error_shows_its_place_and_never_its_text():
    result = CliRunner().invoke(failing_app(ValueError(f"descriptor {SECRET}")), ["fail"])
    assert result.exit_code == 1
    assert SECRET not in result.stderr
    assert "ValueError at test_errors.py:" in result.stderr
