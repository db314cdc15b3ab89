"""The sealed pool of real descriptors."""

import itertools
import traceback
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from templates.decoys import (
    Attributes,
    DecoyGenerator,
    DecoyPool,
    DecoySource,
    container,
    load_source,
)
from templates.decoys.pool import POOL_CONTEXT, POOL_MAGIC
from templates.errors import DecoyError, SealError
from templates.keys.randomness import Keystream
from templates.keys.sealing import MasterKeyring, Sealer

GENDERS = ("Female", "Male")
RACES = ("Black", "East Asian", "Indian", "White")


def unit_rows(count: int, n: int, seed: int = 0) -> NDArray[np.float32]:
    x = np.random.default_rng(seed).normal(size=(count, n))
    return (x / np.linalg.norm(x, axis=1, keepdims=True)).astype(np.float32)


def cross_labels(count: int) -> list[Attributes]:
    every = itertools.cycle(itertools.product(GENDERS, RACES))
    return [Attributes(*next(every)) for _ in range(count)]


@pytest.fixture(scope="module")
def pool() -> DecoyPool:
    return DecoyPool(unit_rows(80, 16), labels=cross_labels(80))


@pytest.fixture
def sealer(tmp_path: Path) -> Sealer:
    return Sealer(MasterKeyring.create(tmp_path / "master.key"))


def indices(pool_rows: NDArray[np.float32], drawn: NDArray[np.float32]) -> NDArray[np.int64]:
    """Which entry each drawn row is, by exact comparison."""
    number = {row.tobytes(): i for i, row in enumerate(pool_rows)}
    flat = drawn.reshape(-1, drawn.shape[-1])
    return np.array([number[row.tobytes()] for row in flat]).reshape(drawn.shape[:-1])


def test_a_pool_that_is_too_small_to_calibrate_with_says_how_many_it_needs() -> None:
    assert DecoyPool(unit_rows(100, 16)).fitted.n == 16
    with pytest.raises(DecoyError, match="the decoy pool has 99 entries; calibrating needs 100"):
        _ = DecoyPool(unit_rows(99, 16)).fitted


def test_draws_are_entries_and_never_repeat_inside_a_row(pool: DecoyPool) -> None:
    drawn = pool.draw(200, 20, stream=Keystream.seeded("pool"))
    assert drawn.shape == (200, 20, 16)
    assert drawn.dtype == np.float32
    assert drawn.flags.c_contiguous
    chosen = indices(unit_rows(80, 16), drawn)
    assert all(len(set(row)) == 20 for row in chosen.tolist())
    # Every entry is drawn about 50 times of 4,000; a binomial count outside 15 … 95 is a fault.
    counts = np.bincount(chosen.ravel(), minlength=80)
    assert counts.min() > 15
    assert counts.max() < 95
    whole = indices(unit_rows(80, 16), pool.draw(1, 80, stream=Keystream.seeded(1)))
    assert sorted(whole[0].tolist()) == list(range(80))
    with pytest.raises(DecoyError, match="81 decoys are needed, but only 80"):
        pool.draw(1, 81, stream=Keystream.seeded(1))


@pytest.mark.parametrize(
    "subject",
    [
        Attributes("Male", "White"),
        Attributes("Male", None),
        Attributes(None, "Indian"),
        Attributes(None, None),
        Attributes("Male", "a race the pool does not know"),
    ],
)
def test_unlike_differs_in_gender_and_in_race(pool: DecoyPool, subject: Attributes) -> None:
    labels = cross_labels(80)
    drawn = pool.draw(50, 8, stream=Keystream.seeded("unlike"), unlike=[subject] * 50)
    chosen = indices(unit_rows(80, 16), drawn)
    seen = {labels[i] for i in chosen.ravel().tolist()}
    allowed = {
        Attributes(g, r)
        for g in GENDERS
        for r in RACES
        if g != subject.gender and r != subject.race
    }
    assert seen == allowed
    assert all(len(set(row)) == 8 for row in chosen.tolist())


def test_an_entry_of_unknown_gender_is_not_of_another_gender() -> None:
    labels = [Attributes(None, "White")] * 10 + [Attributes("Female", "White")] * 10
    pool = DecoyPool(unit_rows(20, 8), labels=labels)
    drawn = pool.draw(5, 10, stream=Keystream.seeded(1), unlike=[Attributes("Male", "Black")] * 5)
    assert indices(unit_rows(20, 8), drawn).min() >= 10
    with pytest.raises(DecoyError, match="only 10 entries"):
        pool.draw(1, 11, stream=Keystream.seeded(1), unlike=[Attributes("Male", "Black")])


def test_unlike_needs_labels_and_one_entry_per_row(pool: DecoyPool) -> None:
    plain = DecoyPool(unit_rows(20, 8))
    with pytest.raises(DecoyError, match="needs a decoy pool with gender and race labels"):
        plain.draw(1, 2, stream=Keystream.seeded(1), unlike=[Attributes("Male", "White")])
    with pytest.raises(DecoyError, match="1 attributes for 2 rows"):
        pool.draw(2, 2, stream=Keystream.seeded(1), unlike=[Attributes("Male", "White")])


@given(count=st.integers(1, 120), data=st.data())
@settings(max_examples=40)
def test_parts_are_disjoint_and_cover_the_pool(count: int, data: st.DataObject) -> None:
    parts_wanted = data.draw(st.integers(1, count))
    parts = DecoyPool(unit_rows(count, 4)).parts(parts_wanted)
    assert len(parts) == parts_wanted
    assert sorted(np.concatenate(parts).tolist()) == list(range(count))
    sizes = [len(part) for part in parts]
    assert max(sizes) - min(sizes) <= 1
    again = DecoyPool(unit_rows(count, 4)).parts(parts_wanted)
    assert all(map(np.array_equal, parts, again))


def test_all_decoys_of_a_row_come_from_one_part(pool: DecoyPool) -> None:
    drawn = pool.draw(60, 5, stream=Keystream.seeded("parts"), sub_databases=16)
    part_of = {i: p for p, part in enumerate(pool.parts(16)) for i in part.tolist()}
    rows = [{part_of[i] for i in row} for row in indices(unit_rows(80, 16), drawn).tolist()]
    assert all(len(parts) == 1 for parts in rows)
    assert len(set.union(*rows)) > 8
    with pytest.raises(DecoyError, match="only 5 entries are in each of 16"):
        pool.draw(1, 6, stream=Keystream.seeded(1), sub_databases=16)
    with pytest.raises(DecoyError, match="cannot be split"):
        pool.draw(1, 1, stream=Keystream.seeded(1), sub_databases=81)


@pytest.mark.parametrize(
    "rows",
    [
        np.ones((3, 4), np.float32),
        np.zeros((3, 4), np.float32),
        np.full((3, 4), np.nan, np.float32),
        np.full((3, 4), np.inf, np.float32),
        np.ones(4, np.float32) / 2,
        np.empty((0, 4), np.float32),
        np.ones((3, 1), np.float32),
    ],
)
def test_rows_that_are_no_descriptors_are_refused(rows: NDArray[np.float32]) -> None:
    with pytest.raises(DecoyError):
        DecoyPool(rows)


def test_a_broken_container_does_not_chain_the_parsers_words() -> None:
    header = b'{"a secret of the header": not JSON}'
    with pytest.raises(DecoyError) as caught:
        container.decode(len(header).to_bytes(8, "little") + header, what="pool", max_bytes=999)
    text = "".join(traceback.format_exception(caught.value))
    assert "DecoyError" in text
    assert "JSONDecodeError" not in text
    assert caught.value.__suppress_context__


def test_the_id_names_descriptors_and_labels() -> None:
    rows = unit_rows(10, 4)
    labels = [Attributes("Male", "White")] * 10
    ids = {
        DecoyPool(rows).source_id,
        DecoyPool(rows[::-1]).source_id,
        DecoyPool(rows, labels=labels).source_id,
        DecoyPool(rows, labels=[*labels[:9], Attributes("Male", None)]).source_id,
    }
    assert len(ids) == 4
    assert DecoyPool(rows.astype(np.float64)).source_id in ids
    with pytest.raises(DecoyError, match="9 labels for 10 embeddings"):
        DecoyPool(rows, labels=labels[:9])


@pytest.mark.parametrize("labels", [None, cross_labels(30)])
def test_a_subset_keeps_rows_labels_and_what_made_them(labels: list[Attributes] | None) -> None:
    rows = unit_rows(30, 8)
    part = DecoyPool(rows, labels=labels, made_with="5a" * 32).subset([29, 3, 7])
    assert np.array_equal(part.entries[0], rows[[29, 3, 7]])
    assert part.entries[1] == (labels and (labels[29], labels[3], labels[7]))
    assert part.made_with == "5a" * 32


@pytest.mark.parametrize(
    "labels", [None, [*cross_labels(28), Attributes(None, "White"), Attributes("Male", None)]]
)
def test_save_and_load(tmp_path: Path, sealer: Sealer, labels: list[Attributes] | None) -> None:
    pool = DecoyPool(unit_rows(30, 8), labels=labels, made_with="5a" * 32)
    path = tmp_path / "decoys.veil"
    pool.save(path, sealer)
    loaded = load_source(path, sealer)
    assert isinstance(loaded, DecoyPool)
    assert isinstance(loaded, DecoySource)
    assert loaded.source_id == pool.source_id
    assert loaded.entries[1] == pool.entries[1]
    assert loaded.made_with == "5a" * 32
    assert np.array_equal(loaded.entries[0], pool.entries[0])


def test_the_file_is_private_and_shows_no_descriptor(tmp_path: Path, sealer: Sealer) -> None:
    rows = unit_rows(30, 8)
    path = tmp_path / "decoys.veil"
    DecoyPool(rows, labels=cross_labels(30)).save(path, sealer)
    data = path.read_bytes()
    assert path.stat().st_mode & 0o777 == 0o600
    assert data.startswith(POOL_MAGIC)
    assert not any(row.tobytes() in data for row in rows)
    assert b"East Asian" not in data
    # Positive control: the plaintext under the seal holds both.
    plain = sealer.open(data[len(POOL_MAGIC) :], context=POOL_CONTEXT)
    assert all(row.tobytes() in plain for row in rows)
    assert b"East Asian" in plain
    assert sorted(p.name for p in tmp_path.iterdir()) == ["decoys.veil", "master.key"]


def test_broken_files_are_refused(tmp_path: Path, sealer: Sealer) -> None:
    path = tmp_path / "decoys.veil"
    DecoyPool(unit_rows(30, 8)).save(path, sealer)
    good = path.read_bytes()
    (tmp_path / "other").mkdir()
    stranger = Sealer(MasterKeyring.create(tmp_path / "other" / "master.key"))
    with pytest.raises(SealError):
        load_source(path, stranger)
    for broken in (good[:-1], good[:-1] + bytes([good[-1] ^ 1]), POOL_MAGIC):
        path.write_bytes(broken)
        with pytest.raises(SealError):
            load_source(path, sealer)
    other = sealer.seal(DecoyGenerator.fit(unit_rows(200, 8)).to_bytes(), context=POOL_CONTEXT)
    for broken in (b"", b"VEILFACE DECOY POOL 2\n" + good, POOL_MAGIC + other):
        path.write_bytes(broken)
        with pytest.raises(DecoyError):
            load_source(path, sealer)
    with pytest.raises(DecoyError, match=r"cannot read missing\.veil"):
        load_source(tmp_path / "missing.veil", sealer)
