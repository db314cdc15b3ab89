"""What a command found, as text and as JSON, and options from a file."""

import datetime
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from api.cli.errors import Commands
from api.cli.results import Plan, Result, Table, reports


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
def other() -> None:
    """So that there is a group."""


def ran(*arguments):
    return CliRunner().invoke(app, ["count", *arguments])


def test_the_same_result_is_text_or_json():
    shown = ran("one", "[bold]three")
    assert shown.exit_code == 0
    assert shown.stdout.startswith("Words:\nCounted")
    assert "[bold]three" in shown.stdout
    facts = json.loads(ran("one", "--json").stdout)
    assert facts == {"path": "a/b", "at": "2026-01-02T00:00:00+00:00", "words": ["one"]}


def test_an_error_is_status_1_beside_the_facts():
    shown = ran("one", "two", "three", "--json")
    assert (shown.exit_code, shown.stderr) == (1, "error: too many words\n")
    assert len(json.loads(shown.stdout)["words"]) == 3


def test_a_plan_gives_options_and_a_flag_wins(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text('words = ["one", "seven", "two"]\nonly-short = true\nmost = 1\n')
    assert ran("--plan", str(plan)).exit_code == 1
    shown = ran("--plan", str(plan), "--most", "5", "--json")
    assert (shown.exit_code, json.loads(shown.stdout)["words"]) == (0, ["one", "two"])


@pytest.mark.parametrize(
    ("text", "refusal"),
    [("colour = 1", "colour"), ("plan = 'x'", "plan"), ("most =", "cannot be read as TOML")],
)
def test_a_plan_that_names_no_option_is_refused(tmp_path, text, refusal):
    plan = tmp_path / "plan.toml"
    plan.write_text(text)
    shown = ran("--plan", str(plan), "one")
    assert shown.exit_code == 2
    assert refusal in shown.stderr
    assert ran("--plan", str(tmp_path / "absent"), "one").exit_code == 2
