"""The commands of docs/deploy.md: a database is backed up, lost and restored; what that undoes."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import psycopg
import pytest
from sqlalchemy.engine import make_url

from api.service.opening import open_keyring, open_store
from api.settings import Settings
from tests.api.cli.conftest import Ran, run
from tests.api.deployment import deploy, environment_of, photo
from tests.databases import empty_database, postgres_server

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "deploy.md").read_text(encoding="utf-8").split("\n## Backups\n")[1]
PAGE = PAGE.split("\n## ")[0]
BLOCKS = re.findall(r"^```sh\n(.*?)^```\n", PAGE, flags=re.M | re.S)
TOLD = "anchor not in chain"


class Drill(NamedTuple):
    """The page's two blocks for a database, and a database for each: before and after."""

    backup: str
    restore: str
    url: str | None
    restored_url: str | None


def need(*programs: str) -> None:
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program}")


@contextmanager
def on_postgres() -> Iterator[Drill]:
    with empty_database() as url:
        database = make_url(url)
        restored = database.set(database=f"{database.database}_restored")
        restored_url = restored.render_as_string(hide_password=False)
        names = {
            "postgresql://postgres@localhost/postgres": postgres_server(),
            "--owner=veilface": f"--owner={database.username}",
            "postgresql://veilface@localhost/veilface_restored": restored_url,
            "postgresql://veilface@localhost/veilface": url,
            "veilface_restored": str(restored.database),
        }
        blocks = [BLOCKS[1], BLOCKS[3]]
        for ours, theirs in names.items():
            blocks = [block.replace(ours, theirs) for block in blocks]
        try:
            yield Drill(*blocks, url, restored_url)
        finally:
            with psycopg.connect(postgres_server(), autocommit=True) as server:
                server.execute(f'DROP DATABASE IF EXISTS "{restored.database}" WITH (FORCE)')


@pytest.fixture(params=["sqlite", "postgres"])
def drill(request: pytest.FixtureRequest) -> Iterator[Drill]:
    assert len(BLOCKS) == 4
    if request.param == "sqlite":
        need("sqlite3")
        yield Drill(BLOCKS[0], BLOCKS[2], None, None)
    else:
        need("pg_dump", "pg_restore", "createdb")
        with on_postgres() as made:
            yield made


def shell(block: str, settings: Settings, folder: Path) -> str:
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block],
        cwd=folder,
        env={
            **{name: value for name, value in os.environ.items() if not name.startswith("PG")},
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            **environment_of(settings),
        },
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, f"{block}\n{done.stdout}"
    return done.stdout


def test_a_database_is_restored_as_the_page_says(drill: Drill, tmp_path: Path) -> None:
    data = tmp_path / "veilface-data"
    deployment = deploy(tmp_path, database_url=drill.url, data_dir=data)
    settings = deployment.settings
    store = open_store(settings, open_keyring(settings))

    def veilface(*words: str | Path) -> Ran:
        return run(*words, "--data-dir", data, "--database-url", settings.resolved_database_url)

    def is_accepted(name: str, person: int) -> bool:
        shown = tmp_path / "shown.png"
        shown.write_bytes(photo(person, 1))
        return veilface("verify", name, shown, "--pack", tmp_path / "tiny").status == 0

    people = {"ann": 1, "ben": 2}
    for name, person in people.items():
        (tmp_path / "photo.png").write_bytes(photo(person))
        enrolled = veilface("enroll", name, tmp_path / "photo.png", "--pack", tmp_path / "tiny")
        assert enrolled.status == 0, enrolled.stderr
    token = deployment.key("verify")
    shell(drill.backup, settings, tmp_path)
    for file in tmp_path.glob("backup*"):
        assert file.stat().st_mode & 0o077 == 0, file
    before = store.audit_log.head().sequence

    # What the backup does not know of.
    assert store.erasures.erase("default", "ann").erased
    key = store.api_keys.verify(token)
    assert key is not None
    assert store.api_keys.revoke(key.prefix)
    later = store.audit_log.head()
    assert not is_accepted("ann", 1)
    store.close()

    shown = shell(drill.restore, settings, tmp_path)
    assert f"intact: yes\nlines: {before}\n" in shown
    settings = settings.model_copy(update={"database_url": drill.restored_url})
    store = open_store(settings, open_keyring(settings))
    assert all(is_accepted(name, person) for name, person in people.items())
    assert not is_accepted("ann", 2)
    assert store.api_keys.verify(token) is not None
    assert veilface("serve", "--check", "--pack", tmp_path / "tiny").status == 0
    told = veilface("audit-log", "verify", "--anchor", str(later))
    assert told.status == 1
    assert TOLD in told.stdout
    assert f"`{TOLD}`" in PAGE
    assert store.erasures.erase("default", "ann").receipt.claims["held"]
    store.close()
