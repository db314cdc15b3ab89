"""The generated part of ``docs/cli.md``. Write it anew: ``python -m tests.api.cli.cli_page``."""

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from api.cli.app import COMMANDS, load

PAGE = Path(__file__).resolve().parents[3] / "docs" / "cli.md"
MARK = "<!-- Below, all is generated: python -m tests.api.cli.cli_page -->\n"
HEAD = "| argument, option | meaning |\n|---|---|\n"
JSON = "| `--json` |"
SEVERAL = 2
"""An option that means the same in so many commands is explained once."""


def leaves(command: Any, *path: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command below one, with its path."""
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name, each in command.commands.items():
        yield from leaves(each, *path, name)


def all_commands() -> dict[tuple[str, ...], Any]:
    """Every command by its path."""
    return {path: leaf for name in COMMANDS for path, leaf in leaves(load(name), name)}


def page() -> str:
    """The whole page: what is written by hand, and a section for each command."""
    head = PAGE.read_text(encoding="utf-8").partition(MARK)[0]
    commands = all_commands()
    counts = Counter(row for command in commands.values() for row in rows(command))
    options = (each for each in counts.items() if each[0].startswith("| `--"))
    shared = {row for row, count in options if count >= SEVERAL}
    table = "".join(sorted(shared))
    without = [f"`{' '.join(path)}`" for path, each in commands.items() if not takes_json(each)]
    table += f"\nAll commands take `--json`, except {', '.join(without)}.\n"
    sections = "".join(section(*each, shared) for each in commands.items())
    return f"{head}{MARK}\n## Options of several commands\n\n{HEAD}{table}{sections}"


def rows(command: Any) -> list[str]:
    """A row for each argument, and each option that is no setting."""
    return [
        f"| {', '.join(f'`{flag}`' for flag in flags)} | {meaning(parameter)} |\n"
        for parameter in command.params
        if getattr(parameter, "rich_help_panel", None) != "Settings"
        and (flags := flags_of(parameter))
    ]


def takes_json(command: Any) -> bool:
    return any(row.startswith(JSON) for row in rows(command))


def flags_of(parameter: Any) -> list[str]:
    if parameter.param_type_name == "argument":
        return [parameter.metavar or str(parameter.name).upper()]
    return [flag for flag in parameter.opts + parameter.secondary_opts if flag != "--help"]


def meaning(parameter: Any) -> str:
    """What the help says, and the default."""
    default = parameter.default
    shown = "" if default in (None, False, True, (), "") else f" Default: `{default}`."
    return " ".join((parameter.help or "").split()).replace("|", "\\|") + shown


def section(path: tuple[str, ...], command: Any, shared: set[str]) -> str:
    """What a command is for, a row for each argument and option of its own, and the shared ones."""
    text, _, example = command.help.strip().partition("Example: ")
    calls = "\n".join(" ".join(call.split()) for call in re.findall(r"`(veilface[^`]+)`", example))
    text += f"```sh\n{calls}\n```"
    own = [row for row in rows(command) if row not in shared]
    also = [
        row.split("|")[1].strip()
        for row in rows(command)
        if row in shared and not row.startswith(JSON)
    ]
    if own:
        text += f"\n\n{HEAD}" + "".join(own).rstrip("\n")
    if also:
        text += f"\n\nAlso {', '.join(also)}."
    return f"\n## `veilface {' '.join(path)}`\n\n{text}\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
