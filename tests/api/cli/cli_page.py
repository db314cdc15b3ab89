"""The generated part of ``docs/cli.md``. Write it anew: ``python -m tests.api.cli.cli_page``."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from api.cli.app import COMMANDS, load

PAGE = Path(__file__).resolve().parents[3] / "docs" / "cli.md"
MARK = "<!-- Below, all is generated: python -m tests.api.cli.cli_page -->\n"


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
    return head + MARK + "".join(section(*each) for each in all_commands().items())


def section(path: tuple[str, ...], command: Any) -> str:
    """What a command is for, and a row for each argument and option."""
    rows, settings = [], []
    for parameter in command.params:
        flags = [flag for flag in parameter.opts + parameter.secondary_opts if flag != "--help"]
        if getattr(parameter, "rich_help_panel", None) == "Settings":
            settings.append(f"`{flags[0]}`")
        elif flags:
            if parameter.param_type_name == "argument":
                flags = [parameter.metavar or str(parameter.name).upper()]
            default = parameter.default
            shown = "" if default in (None, False, True, ()) else f" Default: `{default}`."
            help_text = " ".join((parameter.help or "").split()).replace("|", "\\|")
            rows.append(f"| {', '.join(f'`{flag}`' for flag in flags)} | {help_text}{shown} |\n")
    text, _, example = command.help.strip().partition("Example: ")
    calls = "\n".join(" ".join(call.split()) for call in re.findall(r"`(veilface[^`]+)`", example))
    text += f"```sh\n{calls}\n```"
    if rows:
        text += "\n\n| argument, option | meaning |\n|---|---|\n" + "".join(rows).rstrip("\n")
    if settings:
        shown = ", ".join(settings) if len(settings) < 20 else "all of [settings.md](settings.md)"
        text += f"\n\nSettings as flags: {shown}."
    return f"\n## `veilface {' '.join(path)}`\n\n{text}\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
