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


def lifted(strategy: str, m: int) -> SubspaceBatch:
    stream = Keystream.seeded("known", strategy, m)
    return lift(VICTIMS, strategy=strategy, m=m, source=POOL, stream=stream)


@pytest.mark.parametrize(("strategy", "m"), [("adversarial", 4), ("hybrid", 8)])
def test_all_decoys_and_no_others_are_found_and_the_embedding_is_left(
    strategy: str, m: int
) -> None:
    templates = lifted(strategy, m)
    # Asked for more than there are, it finds only what is there.
    decoys = find_decoys(templates, ENTRIES, most=7)
    distances = np.sort(
        [np.linalg.norm(t.project(ENTRIES) - ENTRIES, axis=1) for t in templates], axis=1
    )
    assert decoys.inside.sum(axis=1).tolist() == [4] * 30
    assert distances[:, :4].max() < TOUCH / 100
    assert distances[:, 4:].min() > 0.5
    rest = strip(templates, ENTRIES, decoys)
    for row, (entries, inside) in enumerate(zip(decoys.entries, decoys.inside, strict=True)):
        span = np.linalg.qr(ENTRIES[entries[inside]].T.astype(np.float64))[0]
        own = VICTIMS[row] - span @ (span.T @ VICTIMS[row])
        if strategy == "adversarial":
            np.testing.assert_allclose(rest[row], own / np.linalg.norm(own), atol=1e-4)
    assert np.einsum("ij,ij->i", rest, VICTIMS).mean() > 0.9


def test_the_face_itself_is_no_decoy() -> None:
    pool = np.vstack([ENTRIES, VICTIMS])
    own = 150 + np.arange(30)
    decoys = find_decoys(lifted("adversarial", 4), pool, most=4, own=own)
    assert decoys.inside.sum(axis=1).tolist() == [4] * 30
    assert not ((decoys.entries == own[:, None]) & decoys.inside).any()
