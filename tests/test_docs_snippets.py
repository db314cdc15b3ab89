"""Every snippet of the documentation is executed, or checked as far as it can be without.

A block that the registry below does not know fails, with its file and line.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
import typer
import typer.main
import yaml

from api.cli.app import COMMANDS, app, load
from api.http.receipts import receipt_key_json
from api.service.opening import open_keyring, open_store
from api.settings import Settings
from models.pack_file import read_pack_file
from templates.store import By
from tests.api.cli.conftest import run
from tests.api.deployment import PROBE_M, Deployment, bearer, deploy, images, photo
from tests.clients.conftest import Running, started
from tests.patience import PATIENCE_S
from tests.ports import free_port
from tests.reliability.proxy import require_nginx, write_configuration
from verify.evaluation.embeddings_file import read_embeddings

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
SETTINGS_ALONE = "sets names for the commands after it"
SAME_IN_README = "the commands of the README, which tests/test_readme.py runs"
OWN_DATA = "needs hours with real data; a test of the command runs it on its own"
NEEDS_A_HOST = "starts containers on a host; the page says what was executed and how"

# Pages of which another test executes every block of a kind.
WHOLE_PAGES = {
    ("docs/tutorial.md", "sh"): "tests/test_tutorial.py",
    ("docs/client.md", "sh"): "tests/clients/test_docs.py",
    ("docs/client.md", "python"): "tests/clients/test_docs.py",
    ("docs/login.md", "js"): "tests/examples/test_login.py",
    ("docs/javascript.md", "js"): "tests/clients/javascript/test_docs.py",
    ("docs/backups.md", "sh"): "tests/test_backup.py",
}
# Blocks that another test executes: page and first line.
ELSEWHERE = {
    ("CONTRIBUTING.md", "make demo"): "tests/test_project.py",
    ("README.md", "make demo"): "tests/test_readme.py",
    ("README.md", "PACK=~/.insightface/models/buffalo_l"): "tests/test_readme.py",
    ("README.md", ". .venv/bin/activate"): "tests/test_readme.py",
    ("README.md", 'curl -X DELETE $URL/anna -H "Authorization: Bearer $KEY" -o receipt.json'): (
        "tests/test_readme.py"
    ),
    (
        "README.md",
        "export VEILFACE_URL=http://127.0.0.1:8421 "
        "VEILFACE_API_KEY=$(cat veilface-data-keys/api-key)",
    ): "tests/examples/test_login.py",
    ("docs/evaluation.md", "LFW=~/lfw.bin"): "tests/test_readme.py",
    ("docs/cli.md", "veilface demo"): "tests/test_tutorial.py",
    ("docs/deployment.md", "DEPLOY=/opt/veilface-deploy"): "tests/test_compose.py",
    ("docs/deployment.md", "python3 -m venv /opt/veilface"): "tests/reliability/test_systemd.py",
    ("docs/deployment.md", "set -e"): "tests/reliability/test_upgrade.py",
}
# Blocks of commands that are executed here, in this process, on a tiny deployment.
HERE = {
    ("docs/cli.md", first)
    for first in (
        "veilface enroll alice alice-1.jpg alice-2.jpg alice-3.jpg --pack buffalo_l",
        "veilface verify alice now-1.jpg now-2.jpg now-3.jpg --pack buffalo_l --level fmr-1e-3",
        "veilface models inspect ~/.insightface/models/buffalo_l",
        "veilface keys create --right enroll --right verify --label web-shop",
        "veilface keys list --tenant default",
        "veilface keys revoke 3f9a1c0b7d2e",
        "veilface keys replace 3f9a1c0b7d2e --grace-hours 48",
        "veilface keys rotate-tenant --tenant default",
        "veilface keys renew audit-before-theft.jsonl",
        "veilface keys master --master-key-file /etc/veilface/master.key",
        "veilface keys rotate --retire",
        "veilface keys rewrap --retire",
        "veilface db upgrade --database-url postgresql+psycopg://veilface@localhost/veilface",
        "veilface db check --data-dir veilface-data",
        "veilface db compact --data-dir veilface-data",
        "veilface db unlock alice --tenant default",
        "veilface db purge --retention-days 730 --retention-disuse-days 365 --dry-run",
        "veilface db erase-tenant acme --confirm acme --out receipt.json",
        "veilface db template-enrollment --tenant default --allow",
        "veilface audit-log verify --anchor head.txt",
        "veilface audit-log head > head.txt",
        "veilface audit-log show --subject alice --limit 100",
        "veilface audit-log archive audit-2026.jsonl",
        "veilface audit-log verify-archive audit-2026.jsonl --public-key contract.json",
        "veilface db current --json",
        "veilface bench models --pack buffalo_l",
    )
}
# Blocks that are executed here by bash, against a running service.
LIVE = [
    ("docs/cli.md", "curl -H \"$AUTH\" https://example.org/v1/contract -o contract.json"),
    ("docs/cli.md", "curl -X DELETE -H \"$AUTH\" https://example.org/v1/subjects/alice "
     "-o receipt.json"),
    ("docs/distances.md", 'python -c "from templates.distances import warm_up; warm_up()"'),
]  # fmt: skip
# Blocks of which only the command lines are checked, and why.
PARSED = {
    ("docs/cli.md", "veilface setup lfw --faces fairface/train --pack buffalo_l"): SAME_IN_README,
    ("docs/cli.md", "veilface decoys build fairface/train --pack buffalo_l"): (
        "tests/api/cli/conftest.py runs these commands on drawn faces"
    ),
    ("docs/cli.md", "veilface models fetch buffalo_sc --from https://example.org/buffalo_sc.zip"): (
        "tests/api/cli/test_models_fetch.py fetches from an address of its own"
    ),
    ("docs/cli.md", "veilface serve --pack buffalo_l --data-dir veilface-data --workers 2"): (
        SAME_IN_README
    ),
    ("docs/cli.md", "veilface calibrate lfw --pack buffalo_l --decoys decoys.veil "
     "--out contract.json \\"): OWN_DATA,
    ("docs/cli.md", "veilface decoys build fairface/train utkface --like volunteers "
     "--pack buffalo_l --out decoys.veil"): OWN_DATA,
    ("docs/cli.md", "veilface evaluate lfw.bin --pack buffalo_l --decoys decoys.veil "
     "--out lfw-results"): OWN_DATA,
    ("docs/cli.md", "veilface evaluate liveness photos --pack buffalo_l --contract contract.json "
     "--decoys decoys.veil \\"): OWN_DATA,
    ("docs/cli.md", "veilface audit fairface fairface --pack buffalo_l --cache fairface.cache "
     "--out audit-fairface"): OWN_DATA,
    ("docs/cli.md", "veilface audit templates lfw --pack buffalo_l --out audit-templates"): (
        OWN_DATA
    ),
    ("docs/cli.md", "veilface bench distances"): OWN_DATA,
    ("docs/evaluation.md", "PACK=~/.insightface/models/buffalo_l"): SETTINGS_ALONE,
    ("docs/evaluation.md", "veilface evaluate $BENCH/lfw.bin --pack $PACK --strategy raw,raw+flip "
     "--out raw"): OWN_DATA,
    ("docs/evaluation.md", "veilface evaluate ~/lfw --pack none --embeddings ~/descriptors.npz "
     "--strategy raw --out raw-elsewhere"): OWN_DATA,
    ("docs/evaluation.md", "veilface decoys build $FACES --pack $PACK --kind pool --limit 10000 "
     "--out pool.veil"): OWN_DATA,
    ("docs/evaluation.md", "veilface evaluate $BENCH/lfw.bin $BENCH/cfp_ff.bin $BENCH/cfp_fp.bin "
     "$BENCH/agedb_30.bin \\"): OWN_DATA,
    ("docs/evaluation.md", "veilface decoys build $FACES --pack $PACK --out generator.veil"): (
        OWN_DATA
    ),
    ("docs/evaluation.md", "veilface evaluate ~/lfw --pack $PACK --labels labels.csv "
     "--strategy raw,random --out groups"): OWN_DATA,
    (
        "docs/evaluation.md",
        "dask scheduler --host 127.0.0.1 --port 8786 --preload veilface &",
    ): OWN_DATA,
    ("docs/liveness.md", "veilface calibrate --liveness booth --bpcer 0.05 --pack buffalo_l "
     "--out contract.json"): OWN_DATA,
    ("docs/liveness.md", "veilface evaluate liveness other-booth --pack buffalo_l "
     "--contract contract.json --decoys decoys.veil \\"): OWN_DATA,
    ("docs/liveness.md", "python -m benchmarks.liveness nuaa celeba_spoof_part --pack MINIFASNET "
     "--pack MINIFASNET_SE \\"): OWN_DATA,
    ("docs/measurements.md", "veilface decoys build fairface/train --pack $PACK --kind pool "
     "--out pool.veil"): OWN_DATA,
    ("docs/operations.md", "veilface serve --host 0.0.0.0 --tls-certificate chain.pem "
     "--tls-key key.pem"): "tests/api/service/test_operations.py starts a service with TLS",
    ("docs/privacy.md", "python -m benchmarks.operating_point --data ../shared/data"): OWN_DATA,
}  # fmt: skip
# Blocks that nothing executes, and why. docs/README.md names these pages.
NOT_EXECUTED = {
    ("docs/operations.md", "caddyfile", "{"): "Caddy is not installed where the tests run",
    ("docs/deployment.md", "sh", "export VEILFACE_DATA=/opt/veilface-deploy/data "
     "VEILFACE_SECRETS=/opt/veilface-deploy/secrets"): NEEDS_A_HOST,
    ("docs/deployment.md", "sh", "pinned() { echo \"$1@$(docker buildx imagetools inspect \"$1\" "
     "--format '{{.Manifest.Digest}}')\"; }"): "asks an image registry; the page says so",
}  # fmt: skip
DRAWINGS = {
    ("docs/architecture.md", "                models"),
    ("docs/architecture.md", "bytes ─▶ protocol"),
    ("docs/architecture.md", "set ─▶ reader"),
    ("docs/distances.md", "__init__ ──▶ exact"),
    ("docs/distances.md", "probes, templates ──stack──▶"),
    ("docs/login.md", "application ──/authorize──▶"),
}
PACKAGES = ("templates", "models", "enroll", "verify", "attacks", "api")


@dataclass(frozen=True)
class Snippet:
    """A block of a page: where it begins, its language, its text."""

    page: str
    line: int
    kind: str
    code: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def first(self) -> str:
        return self.code.split("\n", 1)[0]


def pages(root: Path) -> list[Path]:
    return [*sorted(root.glob("*.md")), *sorted((root / "docs").glob("*.md"))]


def collect(root: Path) -> list[Snippet]:
    """Every fenced block, and every indented line of a command, below a folder."""
    found = []
    for path in pages(root):
        page = path.relative_to(root).as_posix()
        lines = path.read_text(encoding="utf-8").split("\n")
        number = 0
        while number < len(lines):
            line = lines[number]
            fence = re.match(r"^( *)```+ *(\S*)", line)
            if fence:
                end = next(
                    index for index in range(number + 1, len(lines))
                    if lines[index].startswith(f"{fence[1]}```")
                )  # fmt: skip
                code = "\n".join(each[len(fence[1]) :] for each in lines[number + 1 : end])
                found.append(Snippet(page, number + 1, fence[2], code + "\n"))
                number = end
            elif re.match(r"^ {4}(veilface|python|curl) ", line):
                found.append(Snippet(page, number + 1, "sh", line.strip() + "\n"))
            number += 1
    return found


SNIPPETS = collect(ROOT)


def of(kind: str, snippets: list[Snippet] = SNIPPETS) -> list[Snippet]:
    return [snippet for snippet in snippets if snippet.kind == kind]


def find(page: str, first: str) -> Snippet:
    return next(each for each in SNIPPETS if (each.page, each.first) == (page, first))


def is_known(snippet: Snippet) -> bool:
    """Whether a test executes the block, checks it by its kind, or says why not."""
    name = (snippet.page, snippet.first)
    if (snippet.page, snippet.kind) in WHOLE_PAGES:
        return True
    if (snippet.page, snippet.kind, snippet.first) in NOT_EXECUTED:
        return True
    match snippet.kind:
        case "json" | "yaml" | "toml" | "nginx":
            return True
        case "python":
            return snippet.page in PYTHON
        case "sh":
            return name in ELSEWHERE or name in HERE or name in LIVE or name in PARSED
        case "" | "text":
            return any(
                snippet.page == page and snippet.first.startswith(start) for page, start in DRAWINGS
            )
    return False


def unknown(snippets: list[Snippet]) -> list[str]:
    return [
        f"{snippet.where}: no test executes this block ({snippet.kind or 'no language'}): "
        f"{snippet.first}"
        for snippet in snippets
        if not is_known(snippet)
    ]


# Command lines -----------------------------------------------------------------------------


def parts(line: str) -> list[str]:
    lexer = shlex.shlex(line, posix=True, punctuation_chars="();<>|&")
    lexer.whitespace_split = True
    lexer.commenters = "#"
    return list(lexer)


def logical_lines(code: str) -> list[str]:
    return [line for line in code.replace("\\\n", " ").split("\n") if line.strip()]


def command_lines(code: str, program: str = "veilface") -> Iterator[list[str]]:
    """Arguments of every call of a program in a block, wherever it stands in a line."""
    for line in logical_lines(code):
        if program not in line:
            continue
        words = parts(line.replace("$(", "( ").replace("<(", "( "))
        begins = True
        for index, word in enumerate(words):
            follows = words[index + 1] if index + 1 < len(words) else ""
            if word.rsplit("/", 1)[-1] == program and (begins or follows in COMMANDS):
                rest = words[index + 1 :]
                stop = (i for i, each in enumerate(rest) if set(each) <= set("();<>|&"))
                arguments = rest[: next(stop, len(rest))]
                if arguments[:1] and arguments[0] not in ("veilface",):
                    yield arguments
            begins = set(word) <= set("();<>|&") or re.match(r"^\w+=", word) is not None


def descend(words: list[str]) -> tuple[Any, list[str], list[str]]:
    """The command that words begin with, its name, and what is left."""
    command, name, rest = typer.main.get_command(app), ["veilface"], list(words)
    if (both := " ".join(rest[:2])) in COMMANDS:  # a command of two words is one name
        rest[:2] = [both]
    while hasattr(command, "commands") and rest and rest[0] in command.commands:
        name.append(rest[0])
        command = load(rest[0]) if len(name) == 2 else command.commands[rest[0]]
        del rest[0]
    return command, name, rest


def refusal(words: list[str]) -> str | None:
    """What the command line would complain of; nothing is run."""
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


def refused(snippets: list[Snippet]) -> list[str]:
    return [
        f"{snippet.where}: veilface {' '.join(words)}: {complaint}"
        for snippet in of("sh", snippets)
        for words in command_lines(snippet.code)
        if (complaint := refusal(words)) is not None
    ]


def spans_refused(root: Path) -> list[str]:
    """Complaints about `veilface …` in running text: names of commands and options."""
    found = []
    for path in pages(root):
        text = re.sub(r"^( *)```.*?^\1```", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
        for span in re.findall(r"(?<!`)`veilface ([^`]*)`(?!`)", text):
            command, name, rest = descend(parts(span))
            left = next(iter(rest), "")
            if hasattr(command, "commands") and left and not left.startswith("-"):
                found.append(f"{path.name}: `veilface {span}`: no command {' '.join(name)} {left}")
            known = {option for each in command.params for option in
                     (*each.opts, *each.secondary_opts)} | {"--help"}  # fmt: skip
            options = [word.split("=")[0] for word in rest if word.startswith("--")]
            found += [
                f"{path.name}: `veilface {span}`: no option {option}"
                for option in options
                if option not in known
            ]
    return found


# Links -------------------------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^( *)```.*?^\1```", "", path.read_text(encoding="utf-8"), flags=re.M | re.S)
    seen: dict[str, int] = {}
    found = set()
    for heading in re.findall(r"^#+ (.*)$", text, flags=re.M):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        count = seen.get(slug, 0)
        seen[slug] = count + 1
        found.add(f"{slug}-{count}" if count else slug)
    return found


def broken_links(root: Path) -> list[str]:
    found = []
    for path in pages(root):
        page = path.relative_to(root).as_posix()
        fenced = False
        for number, line in enumerate(path.read_text(encoding="utf-8").split("\n"), start=1):
            fenced ^= line.lstrip().startswith("```")
            if fenced:
                continue
            for target in re.findall(r"\]\(([^)\s]+)\)", line):
                if re.match(r"^[a-z]+:", target):
                    continue
                name, _, anchor = target.partition("#")
                file = path.parent / name if name else path
                if not file.exists():
                    found.append(f"{page}:{number}: no such file: {target}")
                elif anchor and anchor not in anchors(file):
                    found.append(f"{page}:{number}: no such heading: {target}")
    return found


# What is executed here ---------------------------------------------------------------------


def formats_md(code: str, folder: Path) -> None:
    names: dict[str, Any] = {"embed": lambda paths: np.eye(len(paths), 4, dtype=np.float32)}
    exec(compile(code, "docs/formats.md", "exec"), names)
    made = read_embeddings(folder / "lfw.npz")
    assert made.descriptors.shape == (len(made.paths), 4)


PYTHON: dict[str, Callable[[str, Path], None]] = {"docs/formats.md": formats_md}


def test_every_block_is_known() -> None:
    assert unknown(SNIPPETS) == []


def test_the_registry_names_no_block_that_is_gone() -> None:
    there = {(each.page, each.first) for each in SNIPPETS}
    named = {*ELSEWHERE, *HERE, *LIVE, *PARSED, *((page, first) for page, _, first in NOT_EXECUTED)}
    assert named - there == set()
    for page, start in DRAWINGS:
        assert any(where == page and first.startswith(start) for where, first in there)
    for test in {*WHOLE_PAGES.values(), *ELSEWHERE.values()}:
        assert (ROOT / test).exists()


def test_the_index_names_every_page_and_every_page_that_is_not_executed() -> None:
    index = (ROOT / "docs" / "README.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^- \[[^\]]*\]\(([^)]+)\)", index, flags=re.M))
    there = {path.name for path in (ROOT / "docs").glob("*.md")} - {"README.md"}
    assert listed == there
    not_executed = index.split("## What is not executed")[1]
    for page in {Path(page).name for page, _, _ in NOT_EXECUTED}:
        assert page in not_executed


def test_the_command_line_accepts_every_command() -> None:
    assert sum(1 for each in of("sh") for _ in command_lines(each.code)) > 50
    assert refused(SNIPPETS) == []


def test_the_command_line_knows_every_command_in_running_text() -> None:
    assert spans_refused(ROOT) == []


def test_benchmarks_exist_with_their_options() -> None:
    calls = [words for each in SNIPPETS for words in command_lines(each.code, "python")]
    modules = [words[1:] for words in calls if words[1].startswith("benchmarks.")]
    assert modules
    for name, *words in modules:
        source = (ROOT / f"{name.replace('.', '/')}.py").read_text(encoding="utf-8")
        assert [word for word in words if word.startswith("--") and f'"{word}"' not in source] == []


def test_every_link_leads_somewhere() -> None:
    assert broken_links(ROOT) == []


@pytest.mark.parametrize("snippet", of("json"), ids=lambda each: each.where)
def test_json_parses(snippet: Snippet) -> None:
    code = snippet.code.replace("[…]", "[]").replace("{…}", "{}")
    assert isinstance(json.loads(code), dict)


@pytest.mark.parametrize("snippet", of("yaml"), ids=lambda each: each.where)
def test_yaml_parses_and_its_metrics_exist(snippet: Snippet) -> None:
    assert yaml.safe_load(snippet.code)["groups"]
    table = (ROOT / snippet.page).read_text(encoding="utf-8").replace(snippet.code, "")
    used = set(re.findall(r"\bveilface_[a-z_]+", snippet.code))
    assert {name.removesuffix("_bucket") for name in used} <= set(
        re.findall(r"`(veilface_[a-z_]+)", table)
    )


@pytest.mark.parametrize("snippet", of("toml"), ids=lambda each: each.where)
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


@pytest.mark.parametrize("snippet", of("nginx"), ids=lambda each: each.where)
def test_nginx_accepts_it(snippet: Snippet, tmp_path: Path) -> None:
    require_nginx()
    path = write_configuration(snippet.code, tmp_path, f"127.0.0.1:{free_port()}")
    done = subprocess.run(
        ["nginx", "-t", "-q", "-p", tmp_path, "-c", path, "-e", tmp_path / "error.log"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "snippet", [each for each in of("python") if each.page in PYTHON], ids=lambda each: each.where
)
def test_python_runs(snippet: Snippet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    PYTHON[snippet.page](snippet.code, tmp_path)


def test_the_architecture_names_what_exists() -> None:
    """Packages and classes that architecture.md names, wherever they are defined."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    packages = re.findall(r"`([a-z]+(?:/\w+)+|\w+/)`", text)
    assert len(packages) > 20
    assert [
        name
        for name in packages
        if not (ROOT / name).is_dir() and not (ROOT / f"{name}.py").exists()
    ] == []
    sources = [path for top in PACKAGES for path in (ROOT / top).rglob("*.py")]
    defined = set(re.findall(r"^class (\w+)", "\n".join(map(Path.read_text, sources)), flags=re.M))
    named = set(re.findall(r"`([A-Z]\w+)`", text))
    assert len(named) > 10
    assert named - defined == set()


def fail_once(deployment: Deployment, subject: str) -> None:
    """A rejected verification, as over REST, where it counts on the subject."""
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    decided = SimpleNamespace(accepted=False, level="fmr-1e-3")
    store.attempts.decide(
        "default",
        subject,
        lambda _: decided,
        contract_id=deployment.contract.contract_id,
        by=By(),
    )
    store.close()


def write_contract_answer(deployment: Deployment, file: Path) -> None:
    """Write what `GET /v1/contract` says of the receipt key that is in force."""
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    answer = {"receipt_key": receipt_key_json(store.signer.public_key())}
    file.write_text(json.dumps(answer))
    store.close()


def test_commands_do_what_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every block of :data:`HERE`, in the order of the page, on one tiny deployment."""
    home = tmp_path / "home"
    (home / ".insightface" / "models").mkdir(parents=True)
    deployment = deploy(tmp_path)
    (home / ".insightface" / "models" / "buffalo_l").symlink_to(tmp_path / "tiny")
    (tmp_path / "buffalo_l").symlink_to(tmp_path / "tiny")
    (tmp_path / "veilface-data").symlink_to(tmp_path / "data")
    names = [f"{stem}-{number}" for stem in ("alice", "now") for number in (1, 2, 3)]
    for shot, name in enumerate(names):
        (tmp_path / f"{name}.jpg").write_bytes(photo(1, shot))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(home))
    assert run("keys", "create", "--right", "verify", "--tenant", "acme").status == 0
    assert run("audit-log", "head").stdout
    blocks = [each for each in SNIPPETS if (each.page, each.first) in HERE]
    assert len(blocks) == len(HERE)
    (anchor,) = (each for each in blocks if "> head.txt" in each.code)
    # A renewal puts the lines up to an earlier anchor into its archive.
    first = next(i for i, each in enumerate(blocks) if "--anchor head.txt" in each.code)
    for snippet in [*blocks[:first], anchor, *blocks[first:]]:
        if "verify-archive" in snippet.code:
            write_contract_answer(deployment, tmp_path / "contract.json")
        if "db unlock" in snippet.code:
            fail_once(deployment, "alice")
        for line in logical_lines(snippet.code):
            line = line.replace(
                "postgresql+psycopg://veilface@localhost/veilface", f"sqlite:///{tmp_path}/new.db"
            )
            line = line.replace("/etc/veilface/master.key", "another.key")
            if "3f9a1c0b7d2e" in line:
                made = run("keys", "create", "--right", "verify", "--json").json
                line = line.replace("3f9a1c0b7d2e", made["prefix"])
            words = [os.path.expanduser(word) for word in parts(line)]  # noqa: PTH111
            target = Path(words[words.index(">") + 1]) if ">" in words else None
            ran = run(*words[1 : words.index(">") if target else None])
            assert ran.status == 0, f"{snippet.where}: {line}\n{ran.stderr}"
            if target:
                target.write_text(ran.stdout)


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("live")
    deployment = deploy(folder)
    deployment.allow_templates()
    with started(deployment, folder) as running:
        yield running


@pytest.mark.long
def test_blocks_for_a_running_service(live: Running, tmp_path: Path) -> None:
    """Every block of :data:`LIVE`, by bash, in the order of the list."""
    (tmp_path / "buffalo_l").symlink_to(live.pack)
    for name, shot in (("me-1", 0), ("me-2", 1), ("now", 2)):
        (tmp_path / f"{name}.jpg").write_bytes(photo(1, shot))
    token = live.deployment.token
    enrolled = httpx.put(
        f"{live.url}/v1/subjects/alice/enrollment",
        headers=bearer(token),
        files=images(photo(2)),
    )
    assert enrolled.status_code == 201
    env = {
        "PATH": f"{BIN}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "HOME": str(tmp_path),
        "AUTH": f"Authorization: Bearer {token}",
        "VEILFACE_API_KEY": token,
    }
    shown = ""
    for page, first in LIVE:
        code = find(page, first).code.replace("https://example.org", live.url)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", code.replace("--dim 4", f"--dim {PROBE_M}")],
            cwd=tmp_path, env=env, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        assert done.returncode == 0, f"{page}: {first}\n{done.stderr}"
        shown += done.stdout
    assert '"decision":"accept"' in shown
    assert "Valid: tenant default erased" in shown


# The collector itself ----------------------------------------------------------------------


def test_what_is_planted_is_found(tmp_path: Path) -> None:
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("# It\n\n[page](docs/page.md#there)\n")
    (tmp_path / "docs" / "page.md").write_text(
        "# There\n\n1. one\n\n   ```sh\n   veilface serve --nope\n   ```\n\n"
        "```sh\nKEY=$(veilface keys create --right enrol)\nsudo veilface lift a.jpg | cat\n"
        "x | veilface frobnicate\n```\n\n    veilface verify\n\n"
        "```python\nprint(1)\n```\n\n```basic\n10 GOTO 10\n```\n\n```\nnothing\n```\n\n"
        "[a](gone.md) [b](#not-there) [c](../README.md#it) `veilface keys lose` "
        "`veilface serve --prot 1` `veilface serve --port 1`\n"
    )
    snippets = collect(tmp_path)
    wheres = [message.split(": ")[0] for message in unknown(snippets)]
    assert wheres == [f"docs/page.md:{line}" for line in (5, 9, 15, 17, 21, 25)]
    complaints = refused(snippets)
    assert [message.split(": ")[0] for message in complaints] == [
        *("docs/page.md:5", "docs/page.md:9", "docs/page.md:9", "docs/page.md:9"),
        "docs/page.md:15",
    ]
    assert "No such option: --nope" in complaints[0]
    assert "'enrol' is not one of" in complaints[1]
    assert "Missing option '--pack'" in complaints[2]
    assert "no such command" in complaints[3]
    assert broken_links(tmp_path) == [
        "docs/page.md:29: no such file: gone.md",
        "docs/page.md:29: no such heading: #not-there",
    ]
    assert spans_refused(tmp_path) == [
        "page.md: `veilface keys lose`: no command veilface keys lose",
        "page.md: `veilface serve --prot 1`: no option --prot",
    ]
