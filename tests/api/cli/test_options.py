"""Flags that commands share, and the one way in which results are shown."""

import datetime
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from api.cli.errors import Commands
from api.cli.options import Plan, reports
from api.cli.results import Result, Table
from api.settings import CONFIG_VARIABLE, Settings


@dataclass(frozen=True)
class Facts:
    path: Path
    at: datetime.datetime
    words: list[str]


app = typer.Typer(cls=Commands, pretty_exceptions_enable=False)


@app.command()
@reports()
def count(
    words: Annotated[list[str], typer.Argument()],
    *,
    most: int = 2,
    only_short: Annotated[bool, typer.Option("--only-short")] = False,
    plan: Plan = None,
) -> Result:
    kept = [word for word in words if not only_short or len(word) < 4]
    return Result(
        Facts(Path("a/b"), datetime.datetime(2026, 1, 2, tzinfo=datetime.UTC), kept),
        ["Words:", Table("Counted", ("word", "letters"), [(word, len(word)) for word in kept])],
        error="too many words" if len(kept) > most else None,
    )


@app.command()
@reports("data_dir", "port", "providers")
def show(word: str, *, settings: Settings) -> None:
    typer.echo(f"{word} {settings.data_dir} {settings.port} {settings.providers}")
    typer.echo(os.environ.get(CONFIG_VARIABLE, "-"))


@app.command()
@reports()
def tell() -> Result:
    keys = [{"prefix": "ab", "rights": ["verify"], "expires_at": None}]
    return Result({"is_valid": True, "share": 1 / 3, "claims": {"tenant": "acme"}, "keys": keys})


@pytest.fixture(autouse=True)
def no_other_settings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("VEILFACE_")]:
        monkeypatch.delenv(name)


def ran(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_same_result_is_text_or_json():
    shown = ran("count", "one", "[bold]three")
    assert shown.exit_code == 0
    assert shown.stdout.startswith("Words:\nCounted")
    assert "[bold]three" in shown.stdout
    facts = json.loads(ran("count", "one", "--json").stdout)
    assert facts == {"path": "a/b", "at": "2026-01-02T00:00:00+00:00", "words": ["one"]}


def test_facts_without_a_text_are_lines_and_tables():
    lines = [line.strip() for line in ran("tell").stdout.splitlines()]
    assert lines[:4] == ["is valid: yes", "share: 0.3333", "claims tenant: acme", "keys"]
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in lines if "│" in line]
    assert cells == [["ab", "verify", "none"]]


def test_an_error_is_status_1_beside_the_facts():
    shown = ran("count", "one", "two", "three", "--json")
    assert (shown.exit_code, shown.stderr) == (1, "error: too many words\n")
    assert len(json.loads(shown.stdout)["words"]) == 3


def test_a_plan_gives_options_and_a_flag_wins(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text('words = ["one", "seven", "two"]\nonly-short = true\nmost = 1\n')
    assert ran("count", "--plan", plan).exit_code == 1
    shown = ran("count", "--plan", plan, "--most", "5", "--json")
    assert (shown.exit_code, json.loads(shown.stdout)["words"]) == (0, ["one", "two"])


@pytest.mark.parametrize(
    ("text", "refusal"),
    [("colour = 1", "colour"), ("plan = 'x'", "plan"), ("most =", "cannot be read as TOML")],
)
def test_a_plan_that_names_no_option_is_refused(tmp_path, text, refusal):
    plan = tmp_path / "plan.toml"
    plan.write_text(text)
    shown = ran("count", "--plan", plan, "one")
    assert (shown.exit_code, refusal in shown.stderr) == (2, True)
    assert ran("count", "--plan", tmp_path / "absent", "one").exit_code == 2


def test_a_flag_wins_over_the_environment_and_that_over_the_file(tmp_path, monkeypatch):
    file = tmp_path / "mine.toml"
    file.write_text('data_dir = "from-file"\nport = 1111\nproviders = "cpu,cuda"\n')
    monkeypatch.setenv("VEILFACE_PORT", "2222")
    shown = ran("show", "hello", "--config", file, "--data-dir", "from-flag")
    # Workers know the file, and it is forgotten afterwards.
    assert shown.stdout.splitlines() == ["hello from-flag 2222 ('cpu', 'cuda')", str(file)]
    assert CONFIG_VARIABLE not in os.environ


@pytest.mark.parametrize(
    ("flags", "said"),
    [(("--port", "99999"), "setting port:"), (("--config", "absent.toml"), "is not a file")],
)
def test_a_wrong_setting_is_one_sentence(flags, said):
    shown = ran("show", "hello", *flags)
    assert (shown.exit_code, said in shown.stderr) == (1, True)
