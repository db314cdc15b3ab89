from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from templates.decoys import Attributes, DecoyPool
from templates.errors import InvalidEmbedding, LiftingError
from templates.keys.randomness import Keystream
from templates.space import lifting
from templates.space.lifting import Strategy, lift

N = 48
# (decoys, random directions) of m = 7, by docs/method.md §2.1.
SHARES = {
    "random": (0, 7),
    "adversarial": (7, 0),
    "hybrid": (3, 4),
    "hybrid+": (3, 4),
    "sub-adversarial": (7, 0),
    "sub-hybrid": (3, 4),
}


def units(stream: Keystream, count: int, n: int = N) -> np.ndarray:
    rows = stream.normal((count, n))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


class Listed:
    """A source that gives the listed decoys and records what it was asked."""

    source_id = "0" * 64

    def __init__(self, *draws: np.ndarray) -> None:
        self.n = self.k = draws[0].shape[-1]
        self.draws = list(draws)
        self.asked: list[tuple[int, int, Sequence[Attributes] | None, int | None]] = []

    def draw(self, rows, k, *, stream, unlike=None, sub_databases=None):
        self.asked.append((rows, k, unlike, sub_databases))
        decoys = self.draws.pop(0) if len(self.draws) > 1 else self.draws[0]
        return np.broadcast_to(decoys[..., :k, :], (rows, k, self.n)).astype(np.float32)


@pytest.fixture
def pool() -> DecoyPool:
    labels = [Attributes("Male" if i % 2 else "Female", "ABC"[i % 3]) for i in range(640)]
    return DecoyPool(units(Keystream.seeded("pool"), 640).astype(np.float32), labels=labels)


def lifted(descriptors: np.ndarray, strategy: str, pool: DecoyPool, **options):
    if strategy == "hybrid+":
        options.setdefault("attributes", [Attributes("Male", "A")] * len(descriptors))
    source = None if strategy == "random" else pool
    return lift(descriptors, strategy=strategy, m=7, source=source, **options)


@pytest.mark.parametrize("strategy", [str(strategy) for strategy in Strategy])
def test_template_holds_the_descriptor_and_its_decoys(strategy: str, pool: DecoyPool):
    descriptors = units(Keystream.seeded("people"), 12)
    entries = pool.draw(1, 640, stream=Keystream.seeded("all"))[0]
    for template, descriptor in zip(lifted(descriptors, strategy, pool), descriptors, strict=True):
        template.validate(1e-6)
        assert template.m == 7
        assert template.contains(descriptor)
        assert int(template.contains(entries, tol=1e-4).sum()) == SHARES[strategy][0]


@pytest.mark.parametrize(
    ("strategy", "labels", "sub_databases"),
    [
        ("hybrid+", [Attributes("Female", "C")] * 2, None),
        ("sub-hybrid", None, 16),
        ("hybrid", None, None),
    ],
)
def test_a_strategy_asks_for_its_kind_of_decoys(
    strategy: str, labels: list[Attributes] | None, sub_databases: int | None
):
    source = Listed(units(Keystream.seeded("decoys"), 4))
    people = units(Keystream.seeded("people"), 2)
    lift(people, strategy=strategy, m=8, source=source, attributes=labels)
    assert source.asked == [(2, 4, labels, sub_databases)]


def test_lifts_of_two_descriptors_that_span_one_set_are_equal():
    """A template is a function of the set and of fresh randomness: of nothing else."""
    members = units(Keystream.seeded("set"), 6)
    templates = []
    for first in range(6):
        source = Listed(np.delete(members, first, axis=0))
        stream = Keystream.seeded("fresh")
        template = lift(
            members[first : first + 1], strategy="adversarial", m=5, source=source, stream=stream
        )
        templates.append(template[0])
    for template in templates[1:]:
        # The decoys pass through float32, so the sets agree to its rounding.
        np.testing.assert_allclose(template.foot, templates[0].foot, atol=2e-6)
        np.testing.assert_allclose(template.basis, templates[0].basis, atol=2e-6)


def test_a_seeded_batch_does_not_depend_on_the_tile(
    pool: DecoyPool, monkeypatch: pytest.MonkeyPatch
):
    descriptors = units(Keystream.seeded("people"), 9)
    monkeypatch.setattr(lifting, "_TILE_BYTES", 2 * 8 * 7 * N)
    templates = lifted(descriptors, "hybrid", pool, stream=Keystream.seeded(1))
    again = lifted(descriptors, "hybrid", pool, stream=Keystream.seeded(1))
    np.testing.assert_array_equal(again.bases, templates.bases)
    assert len(templates) == 9
    assert all(t.contains(d) for t, d in zip(templates, descriptors, strict=True))


def test_a_photo_drawn_twice_is_drawn_again():
    decoys = units(Keystream.seeded("decoys"), 4)
    descriptors = units(Keystream.seeded("people"), 2)
    nearly = decoys[1] + 7e-4 * decoys[3]
    twice = np.vstack([decoys[:2], nearly / np.linalg.norm(nearly), decoys[2]])
    own = np.vstack([decoys[:3], descriptors[1]])
    for bad in (twice, own):
        source = Listed(np.stack([decoys, bad]), decoys)
        templates = lift(
            descriptors, strategy="adversarial", m=4, source=source, stream=Keystream.seeded(1)
        )
        assert [asked[0] for asked in source.asked] == [2, 1]  # only the bad row
        assert all(template.contains(decoys, tol=1e-4).all() for template in templates)
    with pytest.raises(LiftingError, match="same photo twice"):
        lift(descriptors, strategy="adversarial", m=4, source=Listed(twice))


@given(m=st.integers(1, 11), seed=st.integers(0, 10**6))
def test_every_dimension_from_1_to_n_minus_1_works(m: int, seed: int):
    descriptors = units(Keystream.seeded(seed), 2, n=12)
    templates = lift(descriptors, strategy="random", m=m, stream=Keystream.seeded(seed, 1))
    for template, descriptor in zip(templates, descriptors, strict=True):
        template.validate(1e-6)
        assert template.contains(descriptor, tol=1e-4)
    assert len(lift(descriptors[:0], strategy="random", m=m)) == 0


def test_requests_that_cannot_be_met_are_refused(pool: DecoyPool):
    good = units(Keystream.seeded("people"), 2)
    for options, reason in (
        ({"strategy": "random", "m": 0}, "out of range"),
        ({"strategy": "random", "m": N}, "out of range"),
        ({"strategy": "nonsense", "m": 2}, "unknown lifting strategy"),
        ({"strategy": "adversarial", "m": 2}, "needs a decoy source"),
        ({"strategy": "hybrid", "m": 1, "source": pool}, "no decoy"),
        ({"strategy": "hybrid+", "m": 4, "source": pool}, "needs the attributes"),
        ({"strategy": "hybrid", "m": 4, "source": pool, "attributes": []}, "leave them out"),
        ({"strategy": "hybrid", "m": 4, "source": Listed(units(Keystream.seeded(1), 4, 9))}, "fit"),
    ):
        with pytest.raises(LiftingError, match=reason):
            lift(good, **options)


def test_descriptors_must_be_finite_unit_vectors():
    good = units(Keystream.seeded("people"), 2)
    near = lift(good * 1.0009, strategy="random", m=3)
    assert all(t.contains(d, 1e-6) for t, d in zip(near, good, strict=True))  # renormalised
    nan, infinite = good.copy(), good.copy()
    nan[1, 0], infinite[0, 1] = np.nan, np.inf
    for bad, reason in (
        (good * 1.002, "norm 1 within"),
        (good * 0, "norm 1 within"),
        (good * 1e300, "norm 1 within"),  # without overflowing: a warning is an error
        (nan, "not finite"),
        (infinite, "not finite"),
        (good[0], "shape"),
        (np.eye(4, dtype=np.int64), "floating-point"),
    ):
        with pytest.raises(InvalidEmbedding, match=reason):
            lift(bad, strategy="random", m=2)
