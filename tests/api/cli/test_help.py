"""Every command explains itself, and docs/cli.md knows every command and option."""

import pytest

from api.cli.app import COMMANDS, load
from tests.api.cli.cli_page import PAGE, all_commands, page
from tests.api.cli.conftest import run

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
    ),
    *("keys create", "keys list", "keys revoke", "keys rotate", "keys rewrap"),
    *("keys verify-receipt", "keys rotate-tenant", "keys renew"),
    *("db unlock", "db purge", "db erase-tenant", "db template-enrollment"),
    *("audit-log verify", "audit-log head", "audit-log show"),
    *("audit-log archive", "audit-log verify-archive"),
    *("bench distances", "bench models"),
}


ALL = all_commands()


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


def test_the_page_is_what_the_commands_say_of_themselves():
    """Else: python -m tests.api.cli.cli_page."""
    assert page() == PAGE.read_text(encoding="utf-8")


def test_no_command_shows_the_help_and_is_wrong_usage():
    shown = run()
    assert shown.status == 2
    assert "veilface demo" in shown.stdout + shown.stderr


@pytest.mark.parametrize("arguments", [["unknown"], ["verify"], ["serve", "--port", "x"]])
def test_wrong_usage_is_status_2(arguments):
    assert run(*arguments).status == 2
