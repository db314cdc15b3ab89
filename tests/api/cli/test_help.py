"""Every command explains itself, and docs/cli.md knows every command and option."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from api.cli.app import COMMANDS, load
from tests.api.cli.conftest import run

DOCS = Path(__file__).resolve().parents[3] / "docs" / "cli.md"
PROMISED = {
    *("demo", "setup", "serve", "enroll", "verify", "lift", "calibrate", "evaluate"),
    "evaluate liveness",
    *("audit fairface", "audit templates"),
    *(
        "decoys build",
        "models inspect",
        "models fetch",
        "db upgrade",
        "db check",
        "db compact",
        "db current",
    ),
    *("keys create", "keys list", "keys revoke", "keys master", "keys rotate", "keys rewrap"),
    *("keys verify-receipt", "keys replace", "keys rotate-tenant", "keys renew"),
    *("db unlock", "db purge", "db erase-tenant", "db template-enrollment"),
    *("audit-log verify", "audit-log head", "audit-log show"),
    *("audit-log archive", "audit-log verify-archive"),
    *("bench distances", "bench models"),
}


def leaves(command: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name, each in command.commands.items():
        yield from leaves(each, *path, name)


ALL = {path: leaf for name in COMMANDS for path, leaf in leaves(load(name), name)}


def test_the_commands_are_those_promised():
    assert {" ".join(path) for path in ALL} == PROMISED


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_commands_says_what_each_says_of_itself(name):
    assert load(name).help.split("\n\n")[0].replace("\n", " ") == COMMANDS[name]


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_help_lets_a_newcomer_act(path):
    shown = run(*path, "--help")
    assert shown.status == 0
    text = ALL[path].help
    assert "Example: " in text
    assert f"veilface {' '.join(path)}" in text
    assert all(
        getattr(parameter, "help", None) or parameter.name == "help"
        for parameter in ALL[path].params
    )


@pytest.mark.parametrize("path", ALL, ids=" ".join)
def test_the_documentation_knows_every_command_and_option(path):
    text = DOCS.read_text(encoding="utf-8")
    heading = f"## `veilface {' '.join(path)}`"
    assert heading in text
    section = text.split(heading, 1)[1].split("\n## ", 1)[0]
    own = [
        name
        for parameter in ALL[path].params
        if getattr(parameter, "rich_help_panel", None) != "Settings"
        for name in parameter.opts
        if name.startswith("--") and name not in ("--help", "--json")
    ]
    assert [name for name in own if f"`{name}" not in section] == []
    takes_settings = any(
        getattr(parameter, "rich_help_panel", None) == "Settings" for parameter in ALL[path].params
    )
    assert ("Settings as flags: " in section) == takes_settings
    assert ("`--json`" in section) == any("--json" in p.opts for p in ALL[path].params)


def test_no_command_shows_the_help_and_is_wrong_usage():
    shown = run()
    assert shown.status == 2
    assert "veilface demo" in shown.stdout + shown.stderr


@pytest.mark.parametrize("arguments", [["unknown"], ["verify"], ["serve", "--port", "x"]])
def test_wrong_usage_is_status_2(arguments):
    assert run(*arguments).status == 2


@pytest.mark.parametrize(
    ("path", "arguments", "option"),
    [
        (("evaluate",), ["lfw.bin"], "repeats"),
        (("audit", "fairface"), ["fairface"], "attacked"),
        (("audit", "templates"), ["people"], "victims"),
    ],
)
def test_quick_is_what_the_page_says_where_nothing_else_is_given(path, arguments, option):
    command = ALL[path]
    shown = next(each.help for each in command.params if "--quick" in each.opts)
    flags = shown.split("`")[1]
    section = DOCS.read_text().split(f"## `veilface {' '.join(path)}`", 1)[1].split("\n## ", 1)[0]
    assert f"`{flags}`" in section
    quick = command.make_context("it", [*arguments, "--quick"]).params
    written = command.make_context("it", [*arguments, *flags.split()]).params
    assert {**quick, "_quick": False} == written
    chosen = command.make_context("it", [*arguments, "--quick", f"--{option}", "150"]).params
    assert chosen == {**quick, option: 150}
    assert command.make_context("it", arguments).params != written
