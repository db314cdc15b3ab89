"""What the neighbour search costs: measured on a slice, and reckoned for the paper's sizes."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import numpy as np

from attacks.attributes.neighbours import nearest_neighbours
from attacks.attributes.plan import AttributePlan
from templates.contract.canonical import Json
from templates.distances.blas import single_threaded
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift

PAPER_FACES = 76_744
PAPER_TEMPLATES = 10_954
_MILLION = 1_000_000
_FACES, _TEMPLATES, _REPEATS = 4096, 512, 3
"""The slice, of which the least time counts: whatever else the machine does only adds to it. Both
sides are searched in tiles of these sizes at most, so that a larger slice costs as much a pair."""


@dataclass(frozen=True)
class SearchCost:
    """Time of the search by both metrics.

    Parameters
    ----------
    pairs
        (template, face) pairs that were timed.
    seconds
        The time they took: the least of the repeats.
    """

    n: int
    m: int
    k: int
    threads: int
    pairs: int
    seconds: float

    @property
    def per_million(self) -> float:
        """Seconds for a million pairs."""
        return self.seconds * _MILLION / self.pairs

    def to_json(self) -> dict[str, Json]:
        """JSON form, with the estimate for one scheme at the paper's size."""
        pairs = full_pairs(AttributePlan(), faces=PAPER_FACES, templates=PAPER_TEMPLATES)
        return {
            **asdict(self),
            "seconds_per_million_pairs": self.per_million,
            "paper_faces": PAPER_FACES,
            "paper_templates": PAPER_TEMPLATES,
            "full_size_pairs": pairs,
            "full_size_seconds": self.per_million * pairs / _MILLION,
        }


def full_pairs(plan: AttributePlan, *, faces: int, templates: int) -> int:
    """Number of (template, face) pairs of the searches that `run_scheme` makes for one scheme.

    The attacked templates meet all of the attacker's faces; those that the attacker lifts itself
    meet the nearby ones of the other folds. A pool's decoys and the search for guesses, a few
    per cent more, are left out, and so is the training.
    """
    gallery = min(plan.gallery_most, faces - faces // plan.folds)
    own = plan.lifts_of(faces) * min(plan.training_most, faces)
    return templates * faces + own * gallery


def measure_cost(*, n: int, m: int) -> SearchCost:
    """Time the neighbour search on random unit rows: it takes the same time on real faces."""
    plan = AttributePlan()
    k, threads = plan.neighbours, plan.threads
    rows = np.random.default_rng(0).standard_normal((_FACES + _TEMPLATES, n)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    batch = lift(
        rows[:_TEMPLATES], strategy=Strategy.RANDOM, m=m, stream=Keystream.seeded("cost", 0)
    )
    step = -(-_TEMPLATES // threads)
    parts = [batch[start : start + step] for start in range(0, _TEMPLATES, step)]
    spent = []
    with single_threaded(), ThreadPoolExecutor(threads) as pool:
        for _ in range(_REPEATS):
            begun = time.perf_counter()
            for done in [
                pool.submit(nearest_neighbours, part, rows[_TEMPLATES:], k=k) for part in parts
            ]:
                done.result()
            spent.append(time.perf_counter() - begun)
    return SearchCost(n, m, k, threads, _FACES * _TEMPLATES, min(spent))
