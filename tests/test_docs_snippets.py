"""What the pages say is accepted: commands, links, and every block that a program reads.

The commands themselves run in the tests of the command line; those of the README, the tutorial, the
clients and the examples in tests of their own.
"""

import ast
import json
import re
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import typer.main
import yaml
from cryptography import x509

from api.cli.app import COMMANDS, app, load
from api.settings import Settings
from models.pack_file import read_pack_file
from tests.certificates import self_signed
from tests.pages import FENCED, ROOT, Snippet, pages, snippets
from tests.ports import free_port
from tests.required import absent
from verify.evaluation.embeddings_file import read_embeddings

PUNCTUATION = set("();<>|&")


def of_kind(kind: str) -> Any:
    return pytest.mark.parametrize(
        "snippet", [each for each in snippets(ROOT) if each.kind == kind], ids=lambda s: s.where
    )


# Command lines -----------------------------------------------------------------------------


def words_of(line: str) -> list[str]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars="();<>|&")
    lexer.whitespace_split = True
    lexer.commenters = "#"
    return list(lexer)


def command_lines(code: str, program: str = "veilface") -> Iterator[list[str]]:
    """Yield the arguments of every call of a program in a block, wherever it stands in a line."""
    for line in code.replace("\\\n", " ").split("\n"):
        if program not in line:
            continue
        words = words_of(line.replace("$(", "( ").replace("<(", "( "))
        begins = True
        for index, word in enumerate(words):
            follows = words[index + 1] if index + 1 < len(words) else ""
            if word.rsplit("/", 1)[-1] == program and (begins or follows in COMMANDS):
                rest = words[index + 1 :]
                stop = (i for i, each in enumerate(rest) if set(each) <= PUNCTUATION)
                arguments = rest[: next(stop, len(rest))]
                if arguments and arguments[0] != "veilface":
                    yield arguments
            begins = set(word) <= PUNCTUATION or re.match(r"^\w+=", word) is not None


def descend(words: list[str]) -> tuple[Any, list[str], list[str]]:
    """Return the command that words begin with, its name, and the words that remain."""
    command, name, rest = typer.main.get_command(app), ["veilface"], list(words)
    if (both := " ".join(rest[:2])) in COMMANDS:  # a command of two words is one name
        rest[:2] = [both]
    while hasattr(command, "commands") and rest and rest[0] in command.commands:
        name.append(rest[0])
        command = load(rest[0]) if len(name) == 2 else command.commands[rest[0]]
        del rest[0]
    return command, name, rest


def refusal(words: list[str]) -> str | None:
    """Return what the command line would complain of; nothing is run."""
    command, name, rest = descend(words)
    if hasattr(command, "commands"):
        return f"no such command: {' '.join([*name, *rest[:1]])}"
    try:
        command.make_context(" ".join(name), rest)
    except typer.TyperException as error:
        return error.format_message() if hasattr(error, "format_message") else str(error)
    except typer.Exit:
        return None
    return None


def refused_commands(root: Path) -> list[str]:
    return [
        f"{snippet.where}: veilface {' '.join(words)}: {complaint}"
        for snippet in snippets(root)
        if snippet.kind == "sh"
        for words in command_lines(snippet.code)
        if (complaint := refusal(words)) is not None
    ]


def broken_files(root: Path) -> list[str]:
    """Return links to files that do not exist; the site's builder checks headings too."""
    return [
        f"{path.relative_to(root).as_posix()}: {target}"
        for path in pages(root)
        for target in re.findall(
            r"\]\(([^)#\s]+)[^)\s]*\)", FENCED.sub("", path.read_text(encoding="utf-8"))
        )
        if not re.match(r"[a-z]+:", target) and not (path.parent / target).exists()
    ]


def test_the_command_line_accepts_every_command() -> None:
    assert sum(1 for each in snippets(ROOT) for _ in command_lines(each.code)) > 50
    assert refused_commands(ROOT) == []


def test_every_command_that_a_message_names_exists() -> None:
    """In any string of the product: messages, help and docstrings."""
    packages = ("api", "attacks", "clients", "enroll", "models", "templates", "verify")
    named = set()
    for path in (each for package in packages for each in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                named |= set(
                    re.findall(r"`veilface\s+([a-z][a-z-]*(?:\s+[a-z][a-z-]*)*)", node.value)
                )
    assert len(named) > 20
    for words in map(str.split, named):
        command, _, rest = descend(words)
        assert not (rest and hasattr(command, "commands")), words


def test_every_link_leads_to_a_file() -> None:
    assert broken_files(ROOT) == []


@of_kind("json")
def test_json_parses(snippet: Snippet) -> None:
    code = snippet.code.replace("[…]", "[]").replace("{…}", "{}")
    assert isinstance(json.loads(code), dict)


@of_kind("yaml")
def test_yaml_parses_and_its_metrics_exist(snippet: Snippet) -> None:
    assert yaml.safe_load(snippet.code)["groups"]
    table = (ROOT / snippet.page).read_text(encoding="utf-8").replace(snippet.code, "")
    used = set(re.findall(r"\bveilface_[a-z_]+", snippet.code))
    assert {name.removesuffix("_bucket") for name in used} <= set(
        re.findall(r"`(veilface_[a-z_]+)", table)
    )


@of_kind("toml")
def test_toml_is_read(snippet: Snippet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    values = tomllib.loads(snippet.code)
    if snippet.page == "docs/models.md":
        (tmp_path / "pack.toml").write_text(snippet.code)
        stated = read_pack_file(tmp_path)
        assert [name for name in vars(stated).values() if name is not None]
        return
    monkeypatch.chdir(tmp_path)
    assert set(values) <= set(Settings.model_fields)
    Settings(**values)


@of_kind("nginx")
def test_nginx_accepts_it(snippet: Snippet, tmp_path: Path) -> None:
    if shutil.which("nginx") is None:
        absent("nginx is not installed", "VEILFACE_REQUIRE_NGINX")
    certificate, _ = self_signed(tmp_path, host=x509.DNSName("faces.example.org"))
    certificate.rename(tmp_path / "chain.pem")
    block = snippet.code.replace("/etc/ssl/faces/", f"{tmp_path}/")
    block = block.replace("listen 443 ssl", f"listen 127.0.0.1:{free_port()} ssl")
    kept = "".join(
        f"{name}_temp_path {tmp_path}/{name};\n"
        for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    path = tmp_path / "nginx.conf"
    path.write_text(
        f"pid {tmp_path}/pid;\nevents {{}}\nhttp {{\naccess_log off;\n{kept}{block}}}\n"
    )
    done = subprocess.run(
        ["nginx", "-t", "-q", "-p", tmp_path, "-c", path, "-e", tmp_path / "error.log"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_the_embeddings_file_of_the_page_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = (
        each.code
        for each in snippets(ROOT)
        if (each.page, each.kind) == ("docs/formats.md", "python")
    )
    names: dict[str, Any] = {"embed": lambda paths: np.eye(len(paths), 4, dtype=np.float32)}
    exec(compile(code, "docs/formats.md", "exec"), names)
    made = read_embeddings(tmp_path / "lfw.npz")
    assert made.embeddings.shape == (len(made.paths), 4)
