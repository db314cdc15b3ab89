from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import pytest
import sqlalchemy as sa

from templates.errors import SealError
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore, count_wrapped, rewrap_keys
from templates.store.database import Database
from templates.store.rewrap import WRAPPED
from templates.store.schema import Base, SubjectRow
from tests.databases import execute
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import SlowSealing, put

SUBJECTS = [f"s{number}" for number in range(12)]


def wires(store: TemplateStore) -> dict[str, bytes]:
    found = {name: store.subjects.get("default", name) for name in SUBJECTS}
    return {name: each.wire for name, each in found.items() if each is not None}


def test_a_rotation_leaves_nothing_under_the_old_key(
    store: TemplateStore, database_url: str, key_file: Path, keyring: MasterKeyring
) -> None:
    for name in SUBJECTS:
        put(store, name, name.encode())
    new = store.api_keys.create("default", ["verify"])
    pseudonym, rotation = (
        store.signer.pseudonym("default", "s1"),
        store.tenants.rotation_key("default", 1),
    )
    old = keyring.current
    total = sum(count_wrapped(store).values())
    assert count_wrapped(store) == {old: total}
    before = ciphertexts(database_url)

    current = MasterKeyring.add_current(key_file)
    assert count_wrapped(store) == {old: total}
    batches: list[int] = []
    assert rewrap_keys(store, batch=5, progress=batches.append) == total
    assert sum(batches) == total
    assert max(batches) == 5
    assert count_wrapped(store) == {current: total}
    assert rewrap_keys(store) == 0
    assert ciphertexts(database_url) == before  # templates are not touched

    MasterKeyring.drop_retired(key_file, keep=current)
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    fresh.check()
    assert wires(fresh) == {name: name.encode() for name in SUBJECTS}
    assert fresh.signer.pseudonym("default", "s1") == pseudonym
    assert fresh.tenants.rotation_key("default", 1) == rotation
    assert fresh.api_keys.verify(new.token) is not None
    fresh.close()


def ciphertexts(database_url: str) -> set[bytes]:
    database = Database(database_url)
    found = {row.ciphertext for row in execute(database, sa.select(SubjectRow.ciphertext))}
    database.close()
    return found


def test_dropping_the_old_key_too_early_fails_at_the_start(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    put(store, "ada", b"wire")
    current = MasterKeyring.add_current(key_file)
    backup = key_file.read_bytes()
    MasterKeyring.drop_retired(key_file, keep=current)
    early = TemplateStore(database_url, MasterKeyring.load(key_file))
    with pytest.raises(SealError, match="not the master key"):
        early.check()
    with pytest.raises(SealError, match="Put the key back"):
        rewrap_keys(early)
    key_file.write_bytes(backup)
    late = TemplateStore(database_url, MasterKeyring.load(key_file))
    rewrap_keys(late)
    late.check()
    early.close()
    late.close()


def test_an_interrupted_rotation_goes_on_where_it_stopped(
    store: TemplateStore, key_file: Path
) -> None:
    for name in SUBJECTS:
        put(store, name, name.encode())
    MasterKeyring.add_current(key_file)

    def stop(count: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rewrap_keys(store, batch=5, progress=stop)
    counts = count_wrapped(store)
    assert sorted(counts.values())[0] == 5
    assert wires(store) == {name: name.encode() for name in SUBJECTS}  # both keys open meanwhile
    store.check()
    rewrap_keys(store)
    assert len(count_wrapped(store)) == 1
    assert wires(store) == {name: name.encode() for name in SUBJECTS}


def test_a_write_that_sealed_before_the_rotation_is_waited_for(
    store: TemplateStore,
    database_url: str,
    key_file: Path,
    slow_sealing: SlowSealing,
) -> None:
    """It sealed under the old key and has not committed: no query can see it yet."""
    service = TemplateStore(database_url, MasterKeyring.load(key_file))
    service.signer.pseudonym("default", "-")
    with ThreadPoolExecutor(2) as threads:
        writing = threads.submit(put, service, "ada", b"wire")
        assert slow_sealing.sealed.wait(PATIENCE_S)
        current = MasterKeyring.add_current(key_file)
        rotating = threads.submit(rewrap_keys, store)
        early = wait([rotating], timeout=0.5).done
        slow_sealing.go_on.set()
        writing.result()
        rotating.result()
    assert not early
    assert set(count_wrapped(store)) == {current}
    MasterKeyring.drop_retired(key_file, keep=current)
    fresh = TemplateStore(database_url, MasterKeyring.load(key_file))
    found = fresh.subjects.get("default", "ada")
    assert found is not None
    assert found.wire == b"wire"
    service.close()
    fresh.close()


def test_every_wrapped_column_of_the_schema_is_known() -> None:
    """A table that is added with a wrapped blob must be added to the rotation as well."""
    wrapped = {
        (table.name, column.name)
        for table in Base.metadata.tables.values()
        for column in table.columns
        if column.name.startswith("wrapped_")
    }
    known = {(each.table.__tablename__, "wrapped_key") for each in WRAPPED}
    assert known == wrapped
    assert len(WRAPPED) == 3
