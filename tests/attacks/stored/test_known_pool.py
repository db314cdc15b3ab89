"""An attacker with the pool finds the decoys, removes them, and reads what is left."""

import numpy as np
import pytest

from attacks.stored.known_pool import TOUCH, find_decoys, strip
from templates.decoys import DecoyPool
from templates.keys.randomness import Keystream
from templates.space.lifting import lift
from templates.space.subspace import SubspaceBatch
from tests.attacks.attributes.people import faces

POOL = DecoyPool(faces(150, seed=1, n=256).embeddings)
ENTRIES = POOL.entries[0]
VICTIMS = faces(30, seed=2, n=256).embeddings


class Watched:
    """The pool, and what was drawn from it."""

    source_id, made_with, n, k = POOL.source_id, None, POOL.n, POOL.n

    def __init__(self) -> None:
        self.drawn: list[np.ndarray] = []

    def project(self, embeddings: np.ndarray) -> np.ndarray:
        return POOL.project(embeddings)

    def draw(self, rows: int, k: int, **options: object) -> np.ndarray:
        decoys = POOL.draw(rows, k, **options)  # type: ignore[arg-type]
        self.drawn.append(decoys)
        return decoys


def lifted(strategy: str, m: int) -> tuple[SubspaceBatch, np.ndarray]:
    source = Watched()
    stream = Keystream.seeded("known", strategy, m)
    templates = lift(VICTIMS, strategy=strategy, m=m, source=source, stream=stream)
    (drawn,) = source.drawn
    return templates, drawn


@pytest.mark.parametrize(("strategy", "m"), [("adversarial", 4), ("hybrid", 8)])
@pytest.mark.parametrize("half", [False, True])
def test_finds_all_decoys_and_no_other(strategy: str, m: int, half: bool) -> None:
    templates, drawn = lifted(strategy, m)
    if half:  # as a template is stored
        feet, bases = (part.astype(np.float16) for part in (templates.feet, templates.bases))
        templates = SubspaceBatch(feet.astype(np.float32), bases.astype(np.float32))
    # Asked for more than there are, it finds only what is there.
    decoys = find_decoys(templates, ENTRIES, most=7)
    assert decoys.inside.sum(axis=1).tolist() == [4] * 30
    for row in range(30):
        mine = {entry.tobytes() for entry in ENTRIES[decoys.entries[row][decoys.inside[row]]]}
        assert mine == {decoy.tobytes() for decoy in drawn[row]}


@pytest.mark.parametrize(("strategy", "m"), [("adversarial", 4), ("hybrid", 8)])
def test_what_is_left_is_the_embeddings_own_part(strategy: str, m: int) -> None:
    templates, drawn = lifted(strategy, m)
    rest = strip(templates, ENTRIES, find_decoys(templates, ENTRIES, most=4))
    for row in range(30):
        span = np.linalg.qr(drawn[row].T.astype(np.float64))[0]
        own = VICTIMS[row] - span @ (span.T @ VICTIMS[row])
        own /= np.linalg.norm(own)
        if strategy == "adversarial":
            np.testing.assert_allclose(rest[row], own, atol=1e-4)
    foot = templates.feet / np.linalg.norm(templates.feet, axis=1, keepdims=True)
    before, after = (np.einsum("ij,ij->i", rows, VICTIMS).mean() for rows in (foot, rest))
    assert before < 0.6
    assert after > 0.9


def test_another_pool_finds_nothing_and_leaves_the_foot_point() -> None:
    templates, _ = lifted("adversarial", 4)
    other = faces(150, seed=9, n=256).embeddings
    decoys = find_decoys(templates, other, most=4)
    assert not decoys.inside.any()
    feet = templates.feet / np.linalg.norm(templates.feet, axis=1, keepdims=True)
    np.testing.assert_allclose(strip(templates, other, decoys), feet, atol=1e-6)


def test_the_face_itself_is_no_decoy() -> None:
    templates, _ = lifted("adversarial", 4)
    pool = np.vstack([ENTRIES, VICTIMS])
    own = 150 + np.arange(30)
    decoys = find_decoys(templates, pool, most=4, own=own)
    assert decoys.inside.all()
    assert not (decoys.entries == own[:, None]).any()


def test_the_threshold_is_far_from_both_sides() -> None:
    templates, _ = lifted("adversarial", 4)
    distances = np.sort(
        [np.linalg.norm(t.project(ENTRIES) - ENTRIES, axis=1) for t in templates], axis=1
    )
    assert distances[:, :4].max() < TOUCH / 100
    assert distances[:, 4:].min() > 0.5
