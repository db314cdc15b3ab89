"""A store on each database, with a clock that the test sets."""

import threading
import uuid
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from templates.keys.sealing import MasterKeyring
from templates.store import Source, TemplateStore
from templates.store.envelope import seal_template
from templates.store.schema import Base
from tests.databases import (  # noqa: F401
    database_url,
    execute,
    migrate_ahead,
    postgres_database,
    postgres_url,
)
from tests.patience import PATIENCE_S, wait_until

CONTRACT = "c" * 64


class Clock:
    def __init__(self) -> None:
        self.time = datetime(2026, 3, 1, 12, 0, 0, 123456, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.time

    def pass_by(self, **amount: float) -> None:
        self.time += timedelta(**amount)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    path = tmp_path / "master.key"
    MasterKeyring.create(path)
    return path


@pytest.fixture
def keyring(key_file: Path) -> MasterKeyring:
    return MasterKeyring.load(key_file)


@pytest.fixture
def store(database_url: str, keyring: MasterKeyring, clock: Clock) -> Iterator[TemplateStore]:  # noqa: F811
    """An empty store with the tenants "default" and "other"."""
    migrate_ahead(database_url)
    store = TemplateStore(database_url, keyring, clock=clock, timeout=PATIENCE_S)
    store.upgrade()
    store.tenants.create("default")
    store.tenants.create("other")
    yield store
    store.close()


def template_id(store: TemplateStore, subject_id: str, tenant: str = "default") -> str | None:
    """Id of the template that a subject has now."""
    record = store.subjects.describe(tenant, subject_id)
    return None if record is None else record.template_id


def wire_of(store: TemplateStore, subject_id: str, *, tenant: str = "default") -> bytes | None:
    found = store.subjects.get(tenant, subject_id)
    return None if found is None else found.wire


class SlowSealing:
    """Holds every enrollment of this process after it sealed its template, before it commits."""

    def __init__(self) -> None:
        self.sealed, self.go_on = threading.Event(), threading.Event()

    def seal_template(self, *arguments: Any) -> None:
        seal_template(*arguments)
        self.sealed.set()
        assert self.go_on.wait(PATIENCE_S)


@pytest.fixture
def slow_sealing(monkeypatch: pytest.MonkeyPatch) -> SlowSealing:
    slow = SlowSealing()
    monkeypatch.setattr("templates.store.subjects.seal_template", slow.seal_template)
    return slow


def compact_until(store: TemplateStore, condition: Callable[[], bool]) -> None:
    """Compact until PostgreSQL has dropped what was removed.

    It keeps dead rows that an older snapshot may see: another test's, its own vacuum's.
    """

    def compacted() -> bool:
        store.database.compact()
        return condition()

    wait_until(compacted, what="tables without dead rows")


def put(
    store: TemplateStore,
    subject_id: str,
    wire: bytes,
    *,
    tenant: str = "default",
    **changes: Any,
) -> bool:
    """Store a template with ordinary metadata; whether it replaced another one."""
    return store.subjects.put(
        tenant,
        subject_id,
        wire,
        contract_id=changes.pop("contract_id", CONTRACT),
        template_id=changes.pop("template_id", None) or uuid.uuid4().hex,
        source=Source.PHOTOS,
        photos=3,
        **changes,
    )


def count(store: TemplateStore, table: type[Base]) -> int:
    """Rows of a table."""
    query = sa.select(sa.func.count()).select_from(table)
    return int(execute(store.database, query)[0][0])


def pieces(blob: bytes) -> list[bytes]:
    """Short runs of a blob: a page boundary may cut a long one in two."""
    return [blob[at : at + 12] for at in range(0, len(blob) - 12, 12)]


def found(folder: Path, wanted: list[bytes]) -> dict[str, int]:
    """How many of the pieces stand in each file of the folder."""
    counts = {}
    for path in sorted(folder.iterdir()):
        content = path.read_bytes()
        if hits := sum(piece in content for piece in wanted):
            counts[path.name] = hits
    return counts
