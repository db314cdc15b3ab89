import signal
import subprocess
import sys
import uuid
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from numpy.typing import NDArray

from templates.contract import wire
from templates.contract.binding import Binding
from templates.errors import StoreError, StoreUnavailable
from templates.keys.randomness import Keystream
from templates.keys.rotation import ROTATION_VERSION, Rotation, TenantRotation
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy, lift
from templates.store import Attempt, TemplateStore, UnknownTenant, verify_audit_log
from templates.store.audit_log import By
from templates.store.schema import RotationKeyRow, SubjectRow
from templates.store.tenants import RetiredRotation
from tests.databases import execute
from tests.patience import PATIENCE_S
from tests.templates.store.conftest import Clock, SlowSealing, found, pieces, put, wire_of
from tests.templates.store.test_attempts import Says, decide

N, M = 48, 4
OPERATOR = By("operator:kim", "request-1")


def binding(m: int = M) -> Binding:
    return Binding("ab" * 32, {}, N, N, Strategy.RANDOM, m, "cd" * 32, ROTATION_VERSION)


class People:
    """Subjects with a template each, enrolled as the service does it: lifted, then turned."""

    def __init__(self, store: TemplateStore, count: int, *, m: int = M) -> None:
        self._store = store
        self.names = [f"s{number:03}" for number in range(count)]
        stream = Keystream.seeded("rerotation")
        points = stream.normal((count, N))
        self.points = points / np.linalg.norm(points, axis=1, keepdims=True)
        self.templates = lift(self.points, strategy="random", m=m, stream=stream)
        self.binding = binding(m)

    def enroll(
        self, *names: str, tenant: str = "default", dtype: wire.WireDtype = "float16"
    ) -> None:
        epoch = self._store.tenants.get(tenant).rotation_epoch
        for name in names:
            new_id = uuid.uuid4().hex
            self.put(name, self.encoded(name, epoch, new_id, tenant, dtype), epoch, new_id, tenant)

    def encoded(
        self,
        name: str,
        epoch: int,
        template_id: str,
        tenant: str = "default",
        dtype: wire.WireDtype = "float16",
    ) -> bytes:
        rotation = self.rotation(epoch, template_id, tenant)
        turned = self.templates[self.names.index(name)].turned_by(rotation.turned)
        return wire.encode(turned, contract_id=self.binding.contract_id, dtype=dtype)

    def put(
        self, name: str, encoded: bytes, epoch: int, template_id: str, tenant: str = "default"
    ) -> None:
        contract_id = self.binding.contract_id
        options = {"template_id": template_id, "rotation_epoch": epoch, "tenant": tenant}
        put(self._store, name, encoded, contract_id=contract_id, **options)

    def rotation(self, epoch: int, template_id: str, tenant: str = "default") -> Rotation:
        key = self._store.tenants.rotation_key(tenant, epoch)
        return TenantRotation(key, N).of(template_id)

    def misses(self, *, epoch: int | None = None) -> NDArray[np.float64]:
        """How far each person's point lies from their stored template, in an epoch's rotation."""
        gaps = []
        for name, point in zip(self.names, self.points, strict=True):
            stored = self._store.subjects.get("default", name)
            assert stored is not None
            rotation = self.rotation(epoch or stored.record.rotation_epoch, stored.template_id)
            turned = rotation.turned(point)
            gaps.append(turned - wire.decode(stored.wire).subspace.project(turned))
        return np.linalg.norm(gaps, axis=1)


def rows(store: TemplateStore) -> dict[str, Any]:
    """All columns of the default tenant's subjects, by subject id."""
    query = sa.select(SubjectRow.__table__).where(
        SubjectRow.tenant_id == store.tenants.get("default").id
    )
    return {row.subject_id: row._asdict() for row in execute(store.database, query)}


def epochs(store: TemplateStore) -> list[int]:
    owner = store.tenants.get("default").id
    query = sa.select(RotationKeyRow.epoch).where(RotationKeyRow.tenant_id == owner)
    return [row.epoch for row in execute(store.database, query.order_by(RotationKeyRow.epoch))]


def audit(store: TemplateStore, action: str = "tenant-rotate") -> list[tuple[Any, ...]]:
    return [
        (line.outcome, line.tenant, line.actor, line.request_id, line.detail)
        for line in store.audit_log.lines()
        if line.action == action
    ]


def test_a_new_epoch_serves_new_enrollments_and_keeps_the_old(store: TemplateStore) -> None:
    people = People(store, 2)
    people.enroll("s000")
    old = store.tenants.rotation_key("default", 1)
    assert store.rerotation.begin("default", by=OPERATOR) == 2
    people.enroll("s001")
    keys = [old, store.tenants.rotation_key("default", 2), store.tenants.rotation_key("other", 1)]
    assert len(set(keys)) == 3
    assert store.tenants.rotation_key("default", 1) == old
    found = {name: row["rotation_epoch"] for name, row in rows(store).items()}
    assert found == {"s000": 1, "s001": 2}
    assert people.misses().max() < 1e-3
    assert store.tenants.get("other").rotation_epoch == 1
    assert audit(store) == [("begun", "default", "operator:kim", "request-1", "epoch 2")]
    with pytest.raises(UnknownTenant):
        store.rerotation.begin("nobody")


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_moved_templates_are_the_same_sets_in_the_new_rotation(
    store: TemplateStore, clock: Clock, dtype: wire.WireDtype
) -> None:
    people = People(store, 7)
    people.enroll(*people.names, dtype=dtype)
    people.enroll("s003", tenant="other")
    theirs = wire_of(store, "s003", tenant="other")
    before = rows(store)
    clock.pass_by(days=1)

    store.rerotation.begin("default")
    assert len(store.rerotation.subjects_of_old_epochs("default")) == 7
    progress: list[int] = []
    assert store.rerotation.move("default", binding(), batch=3, progress=progress.append) == 7
    assert progress == [3, 3, 1]
    assert store.rerotation.subjects_of_old_epochs("default") == []
    assert store.rerotation.move("default", binding()) == 0

    assert people.misses().max() < 1e-3
    # The new numbers are those of the new rotation only.
    assert people.misses(epoch=1).min() > 0.1
    after = rows(store)
    changed = {"wrapped_key", "ciphertext", "rotation_epoch"}
    for name in people.names:
        different = {key for key in before[name] if before[name][key] != after[name][key]}
        assert different == changed, name
        stored = store.subjects.get("default", name)
        assert stored is not None
        assert wire.decode(stored.wire).dtype == dtype
        assert wire.decode(stored.wire).contract_id == binding().contract_id
    assert wire_of(store, "s003", tenant="other") == theirs


def test_an_enrollment_of_an_older_epoch_is_refused(store: TemplateStore) -> None:
    people = People(store, 1)
    late = people.encoded("s000", 1, "late")
    store.rerotation.begin("default")
    for epoch in (1, 3):
        with pytest.raises(StoreUnavailable, match="rotation was renewed meanwhile; send it again"):
            people.put("s000", late, epoch, "late")
    assert store.subjects.describe("default", "s000") is None
    people.enroll("s000")
    record = store.subjects.describe("default", "s000")
    assert record is not None
    assert record.rotation_epoch == 2


def test_retiring_drops_the_old_keys_once_nothing_needs_them(store: TemplateStore) -> None:
    people = People(store, 4)
    people.enroll(*people.names[:3])
    store.rerotation.begin("default")
    store.rerotation.begin("default")
    people.enroll("s003")
    with pytest.raises(StoreError, match=r"3 templates .* move them first"):
        store.rerotation.retire("default")
    assert epochs(store) == [1, 2, 3]
    store.rerotation.move("default", binding())
    assert store.rerotation.retire("default", by=OPERATOR) == 2
    assert epochs(store) == [3]
    assert store.rerotation.retire("default") == 0
    with pytest.raises(RetiredRotation, match="epoch 1"):
        store.tenants.rotation_key("default", 1)
    assert people.misses().max() < 1e-3
    assert store.tenants.rotation_key("other", 1)
    assert audit(store)[-1] == ("retired", "default", "operator:kim", "request-1", "epoch 3")


def test_a_move_has_its_line_and_takes_back_no_decision(store: TemplateStore) -> None:
    """The template keeps its id: a probe that was compared with it before was compared with it."""
    people = People(store, 3)
    people.enroll(*people.names)
    store.rerotation.begin("default")
    assert store.rerotation.move("default", binding(), by=OPERATOR) == 3
    assert audit(store)[-1] == ("moved", "default", "operator:kim", "request-1", "epoch 2")
    before = store.audit_log.head()
    assert store.rerotation.move("default", binding(), by=OPERATOR) == 0
    assert store.audit_log.head() == before
    store.rerotation.begin("default")
    calls: list[int] = []

    def compare(_: Attempt) -> Says:
        calls.append(store.rerotation.move("default", binding()))
        return Says(accepted=True)

    assert decide(
        store, compare, subject=people.names[0], contract_id=binding().contract_id
    ).accepted
    assert calls == [3]


def test_templates_of_another_contract_are_left_and_named(store: TemplateStore) -> None:
    people, foreign = People(store, 3), People(store, 3, m=M + 1)
    people.enroll("s000")
    foreign.enroll("s001")
    people.enroll("s002")
    kept = wire_of(store, "s001")
    store.rerotation.begin("default")
    assert store.rerotation.move("default", people.binding) == 2
    assert store.rerotation.subjects_of_old_epochs("default") == ["s001"]
    assert wire_of(store, "s001") == kept
    with pytest.raises(StoreError, match="move them first"):
        store.rerotation.retire("default")
    people.enroll("s001")
    assert store.rerotation.retire("default") == 1


KILLED = """
import os, signal, sys
from templates.keys.sealing import MasterKeyring
from templates.store import TemplateStore
from templates.store import rerotation
from tests.templates.store.test_rerotation import binding

url, key_file, place = sys.argv[1:]
seal = rerotation.seal_template

def die(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)

def die_inside(*arguments: object) -> None:
    seal(*arguments)
    die()

if place == "inside":
    rerotation.seal_template = die_inside
store = TemplateStore(url, MasterKeyring.load(key_file))
store.rerotation.move("default", binding(), batch=2, progress=die)
"""


@pytest.mark.long
def test_ten_kills_on_the_way_lose_nothing(
    store: TemplateStore, database_url: str, key_file: Path
) -> None:
    people = People(store, 11)
    people.enroll(*people.names)
    store.rerotation.begin("default")
    for number in range(10):
        # Inside a transaction, and after it.
        place = ("inside", "after")[number % 2]
        command = [sys.executable, "-c", KILLED, database_url, str(key_file), place]
        assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
        assert people.misses().max() < 1e-3
        left = store.rerotation.subjects_of_old_epochs("default")
        assert len(left) == 11 - 2 * ((number + 1) // 2)
    assert store.rerotation.move("default", binding()) == 1
    assert store.rerotation.retire("default") == 1
    assert people.misses().max() < 1e-3
    assert verify_audit_log(store).intact


def test_a_template_that_does_not_open_is_said_and_the_rest_is_moved(store: TemplateStore) -> None:
    people = People(store, 5)
    people.enroll(*people.names)
    people.put("s003", b"no template", 1, "broken")
    execute(store.database, "UPDATE subjects SET template_id = 'x' WHERE subject_id = 's001'")
    store.rerotation.begin("default")
    with pytest.raises(StoreError, match=r"2 templates .* could not be moved") as caught:
        store.rerotation.move("default", binding(), batch=2)
    assert "s001" not in str(caught.value)
    assert store.rerotation.subjects_of_old_epochs("default") == ["s001", "s003"]
    with pytest.raises(StoreError, match="move them first"):
        store.rerotation.retire("default")
    store.erasures.erase("default", "s001")
    people.enroll("s003")
    assert store.rerotation.move("default", binding()) == 0
    assert store.rerotation.retire("default") == 1


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_cells_that_cannot_be_read_stop_no_other_row(store: TemplateStore) -> None:
    people = People(store, 3)
    people.enroll(*people.names)
    execute(
        store.database,
        "UPDATE subjects SET source = 'zzz' WHERE subject_id = 's000'",
        "UPDATE subjects SET wrapped_key = 'zzz' WHERE subject_id = 's001'",
    )
    store.rerotation.begin("default")
    with pytest.raises(StoreError, match="1 templates"):
        store.rerotation.move("default", people.binding)
    assert store.rerotation.subjects_of_old_epochs("default") == ["s001"]


def test_an_enrollment_under_way_is_waited_for_before_a_key_goes(
    store: TemplateStore,
    database_url: str,
    key_file: Path,
    slow_sealing: SlowSealing,
) -> None:
    """It read epoch 1 and has not committed: no query can see its template yet."""
    service = TemplateStore(database_url, MasterKeyring.load(key_file))
    people, slow_people = People(store, 1), People(service, 1)
    with ThreadPoolExecutor(2) as threads:
        writing = threads.submit(slow_people.enroll, "s000")
        assert slow_sealing.sealed.wait(PATIENCE_S)

        def renew() -> None:
            store.rerotation.begin("default")
            store.rerotation.move("default", binding())
            store.rerotation.retire("default")

        renewing = threads.submit(renew)
        early = wait([renewing], timeout=0.5).done
        slow_sealing.go_on.set()
        writing.result()
        failure = renewing.exception()
    assert not early
    # On SQLite `begin` waits, on PostgreSQL `move`: either way `move` sees the template.
    assert failure is None
    assert ("moved", "default", "program", None, "epoch 2") in audit(store)
    assert epochs(store) == [2]
    assert people.misses().max() < 1e-3
    service.close()


def test_sqlite_files_keep_nothing_of_the_old_rotation(
    tmp_path: Path, keyring: MasterKeyring
) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    store = TemplateStore(f"sqlite:///{folder / 'veilface.db'}", keyring)
    store.upgrade()
    store.tenants.create("default")
    people = People(store, 12)
    people.enroll(*people.names)
    row = rows(store)["s007"]
    ((key,),) = execute(store.database, sa.select(RotationKeyRow.wrapped_key))
    ciphertext = pieces(row["ciphertext"])
    data_key, rotation_key = pieces(row["wrapped_key"][9:]), pieces(key[9:])
    assert max(found(folder, ciphertext).values()) >= 0.9 * len(ciphertext)
    assert found(folder, data_key) != {}
    assert found(folder, rotation_key) != {}
    store.rerotation.begin("default")
    store.rerotation.move("default", people.binding, batch=5)
    assert found(folder, ciphertext) == {}
    assert found(folder, data_key) == {}
    store.rerotation.retire("default")
    assert found(folder, rotation_key) == {}
    store.close()
