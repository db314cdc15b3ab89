"""The demo's database: its first API key, and what its file holds in the end."""

import contextlib
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from api.service.opening import prepare_database
from templates.contract import wire
from templates.keys.private_file import create_private
from templates.keys.sealing import MasterKeyring
from templates.store import Right, TemplateStore

TENANT = "default"
KEY_FILE = "master.key"
_EXCERPT = 16


@dataclass(frozen=True)
class Stored:
    """What the database's file holds of one person; the excerpt is ciphertext."""

    name: str
    template_bytes: int
    foot_norm: float
    ciphertext_bytes: int
    ciphertext_excerpt: str


def create_key(folder: Path) -> str:
    """Make the database and an API key with all rights; its token, which ``api-key`` keeps."""
    with contextlib.closing(_store(folder)) as store:
        prepare_database(store)
        store.tenants.create(TENANT)
        token = store.api_keys.create(TENANT, tuple(Right), label="demo").token
    create_private(folder / "api-key", f"{token}\n".encode())
    return token


def read_stored(folder: Path, names: Sequence[str]) -> tuple[Stored, ...]:
    """Read the database's file as a thief would, and open it with the master key beside that."""
    query = "SELECT ciphertext FROM subjects WHERE subject_id = ?"
    stored = []
    with contextlib.closing(_store(folder)) as store:
        for name in names:
            subject = store.subjects.get(TENANT, name)
            if subject is not None:
                ciphertext = bytes(_value(folder, query, name))
                # From the middle: away from the header and the authentication tag.
                start = (len(ciphertext) - _EXCERPT) // 2
                foot_norm = float(wire.decode(subject.wire).subspace.foot_norm)
                excerpt = ciphertext[start : start + _EXCERPT].hex()
                row = Stored(name, len(subject.wire), foot_norm, len(ciphertext), excerpt)
                stored.append(row)
    return tuple(stored)


def rows_of(folder: Path, name: str) -> int:
    """Count the rows that name a person in the clear."""
    return int(_value(folder, "SELECT count(*) FROM subjects WHERE subject_id = ?", name))


def _store(folder: Path) -> TemplateStore:
    url = f"sqlite:///{(folder / 'veilface.db').resolve()}"
    return TemplateStore(url, MasterKeyring.load(folder / KEY_FILE))


def _value(folder: Path, query: str, name: str) -> Any:
    """First column of a query's only row."""
    with contextlib.closing(sqlite3.connect(folder / "veilface.db")) as database:
        return database.execute(query, (name,)).fetchone()[0]
