"""What the database's file holds after the demo."""

import contextlib
import sqlite3
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from templates.contract import wire
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore

TENANT = "default"
KEY_FILE = "master.key"


@dataclass(frozen=True)
class Stored:
    """What the database's file holds of one person; the excerpt is ciphertext."""

    name: str
    n: int
    m: int
    template_bytes: int
    foot_norm: float
    ciphertext_bytes: int
    ciphertext_excerpt: str


def read_stored(folder: Path, names: Sequence[str]) -> tuple[Stored, ...]:
    """Read the database's file as a thief would, and open it with the master key beside that."""
    url = f"sqlite:///{(folder / 'veilface.db').resolve()}"
    store = TemplateStore(url, MasterKeyring.load(folder / KEY_FILE))
    stored = []
    try:
        for name in names:
            subject = store.subjects.get(TENANT, name)
            if subject is None:
                continue
            foot_norm = wire.decode(subject.wire).subspace.foot_norm
            ciphertext = _ciphertext(folder, name)
            stored.append(
                Stored(
                    name=name,
                    n=subject.record.n,
                    m=subject.record.m,
                    template_bytes=len(subject.wire),
                    foot_norm=float(foot_norm),
                    ciphertext_bytes=len(ciphertext),
                    ciphertext_excerpt=_middle(ciphertext).hex(),
                )
            )
    finally:
        store.close()
    return tuple(stored)


def _ciphertext(folder: Path, name: str) -> bytes:
    with contextlib.closing(sqlite3.connect(folder / "veilface.db")) as database:
        row = database.execute(
            "SELECT t.ciphertext FROM templates t JOIN subjects s ON s.id = t.subject_pk "
            "WHERE s.subject_id = ?",
            (name,),
        ).fetchone()
    return bytes(row[0])


def _middle(data: bytes, count: int = 16) -> bytes:
    """Cut some bytes from the middle: away from the header and the authentication tag."""
    start = (len(data) - count) // 2
    return data[start : start + count]


def rows_of(folder: Path, name: str) -> int:
    """Count the rows that name a person in the clear."""
    with contextlib.closing(sqlite3.connect(folder / "veilface.db")) as database:
        query = "SELECT count(*) FROM subjects WHERE subject_id = ?"
        return int(database.execute(query, (name,)).fetchone()[0])
