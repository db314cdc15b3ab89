"""Many at once, and death at any moment: a subject is wholly old, wholly new or wholly gone."""

import hashlib
import json
import os
import random
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

import pytest
import sqlalchemy as sa

from templates.store import TemplateStore
from templates.store.database import Database
from templates.store.schema import ReceiptRow
from tests.databases import execute
from tests.patience import PATIENCE_S, wait_until
from tests.templates.store.conftest import put

SUBJECTS = ("ada", "eve", "kim")
ERASE_EVERY = 5

# The children do nothing but use the store; threads that other tests left behind are not theirs.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")


def wire_of(number: int) -> bytes:
    """A template that shows whether it is whole: its number, and bytes that follow from it."""
    head = number.to_bytes(8, "big")
    return head + hashlib.shake_256(head).digest(20_000)


def number_of(wire: bytes) -> int:
    """Number of a whole template; an assertion fails for a mixture."""
    number = int.from_bytes(wire[:8], "big")
    assert wire == wire_of(number)
    return number


def mix(store: TemplateStore, seed: int, steps: int) -> Counter[str]:
    """Use a few subjects at random; returns how often each was created and erased."""
    generator, done = random.Random(seed), Counter[str]()
    for step in range(steps):
        subject = generator.choice(SUBJECTS)
        match generator.randrange(4):
            case 0 | 1:
                if not put(store, subject, wire_of(seed * 10_000 + step)):
                    done[f"created {subject}"] += 1
            case 2:
                if (found := store.subjects.get("default", subject)) is not None:
                    number_of(found.wire)
                    done["read"] += 1
            case 3:
                if store.erasures.erase("default", subject).erased:
                    done[f"erased {subject}"] += 1
    return done


def write_for_ever(store: TemplateStore, subject: str, output: TextIO) -> None:
    """Enroll, replace and erase; acknowledge each finished step by its number."""
    step = 0
    while True:
        step += 1
        if step % ERASE_EVERY == 0:
            store.erasures.erase("default", subject)
        else:
            put(store, subject, wire_of(step))
        print(step, file=output, flush=True)


def fork(work: Callable[[TextIO], None], *stores: TemplateStore) -> tuple[int, TextIO]:
    """Run `work`, which may use these stores, in another process; returns its id and output."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(reading)
            for store in stores:  # their connections are the parent's
                store.database.engine.dispose(close=False)
            with os.fdopen(writing, "w") as output:
                work(output)
            os._exit(0)
        except BaseException:
            os._exit(1)
    os.close(writing)
    return child, os.fdopen(reading)


def in_processes(work: Callable[[TextIO], None], store: TemplateStore, count: int) -> Iterator[str]:
    """What so many processes write that do the same at the same time."""
    children = [fork(work, store) for _ in range(count)]
    for child, output in children:
        with output:
            yield output.read()
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def assert_equal_to_a_serial_order(store: TemplateStore, done: Counter[str]) -> None:
    """In any serial order, creations and erasures of a subject alternate."""
    for subject in SUBJECTS:
        found = store.subjects.get("default", subject)
        alive = done[f"created {subject}"] - done[f"erased {subject}"]
        assert alive == (0 if found is None else 1), subject
        if found is not None:
            number_of(found.wire)
    held = sa.select(ReceiptRow.sequence).where(ReceiptRow.body.contains('"held":true'))
    assert len(execute(store.database, held)) == sum(
        done[f"erased {subject}"] for subject in SUBJECTS
    )


def test_processes_on_the_same_subjects(store: TemplateStore) -> None:
    def work(output: TextIO) -> None:
        json.dump(mix(store, os.getpid(), 60), output)

    done: Counter[str] = Counter()
    for output in in_processes(work, store, 4):
        done.update(json.loads(output))
    assert done["read"] > 0
    assert_equal_to_a_serial_order(store, done)


def test_a_killed_writer_leaves_whole_subjects(store: TemplateStore) -> None:
    """The state is that of the last acknowledged step, or of the one after it."""
    generator = random.Random(5)
    for round_number in range(12):
        subject = f"s{round_number}"
        child, output = fork(lambda to, subject=subject: write_for_ever(store, subject, to), store)
        with output:
            acknowledged = [output.readline() for _ in range(generator.randrange(1, 12))]
            time.sleep(generator.uniform(0, 0.02))
            os.kill(child, signal.SIGKILL)
            acknowledged += output.read().splitlines()
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL

        last = int(acknowledged[-1])
        found = store.subjects.get("default", subject)
        state = 0 if found is None else number_of(found.wire)
        assert state in {0 if step % ERASE_EVERY == 0 else step for step in (last, last + 1)}
        # The locks of the dead are free.
        store.erasures.erase("default", subject)
        assert store.subjects.get("default", subject) is None


def test_a_process_that_writes_without_a_pause_starves_no_other(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'veilface.db'}"
    busy, other = (Database(url, timeout=PATIENCE_S) for _ in range(2))
    execute(busy, "CREATE TABLE written (n)")
    done, writes, waited = threading.Event(), 0, []

    def write(database: Database) -> None:
        with database.write() as session:
            session.execute(sa.text("INSERT INTO written VALUES (1)"))
            time.sleep(0.005)  # as long as a disk may take

    def write_on() -> None:
        nonlocal writes
        while not done.is_set():
            write(busy)
            writes += 1

    threads = [threading.Thread(target=write_on) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        for work in (lambda: write(other), other.purge_log):
            work()
            for _ in range(20):
                # However slow this machine is, the other one is in the middle of its writes.
                seen = writes
                wait_until(lambda seen=seen: writes > seen + 1, what="writes", every_s=0.005)
                before = writes
                work()
                waited.append(writes - before)
    finally:
        done.set()
        for thread in threads:
            thread.join()
        busy.close()
        other.close()
    assert max(waited) < 20, waited
