"""What the neighbour search costs: measured on a slice, and reckoned for the paper's sizes."""

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from attacks.attributes.neighbours import nearest_neighbours
from attacks.attributes.plan import AttributePlan
from attacks.errors import AuditError
from templates.contract.canonical import Json
from templates.distances.blas import single_threaded
from templates.keys.randomness import Keystream
from templates.space.lifting import Strategy, lift

PAPER_FACES = 76_744
PAPER_TEMPLATES = 10_954
PAPER_N = 512
PAPER_M = 16
_MILLION = 1_000_000


@dataclass(frozen=True)
class SearchCost:
    """Time of the search by both metrics.

    Parameters
    ----------
    n, m
        Dimensions.
    k
        Neighbours that were searched for.
    threads
        Cores that it ran on.
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

    def estimate(self, pairs: int | None = None) -> float:
        """Seconds for so many pairs; by default those of one scheme at the paper's size."""
        return self.per_million * (full_pairs() if pairs is None else pairs) / _MILLION

    def to_json(self) -> dict[str, Json]:
        """JSON form, with the estimate for one scheme at the paper's size."""
        return {
            "n": self.n,
            "m": self.m,
            "k": self.k,
            "threads": self.threads,
            "pairs": self.pairs,
            "seconds": self.seconds,
            "seconds_per_million_pairs": self.per_million,
            "paper_faces": PAPER_FACES,
            "paper_templates": PAPER_TEMPLATES,
            "full_size_pairs": full_pairs(),
            "full_size_seconds": self.estimate(),
        }


def full_pairs(
    plan: AttributePlan | None = None,
    *,
    faces: int = PAPER_FACES,
    templates: int = PAPER_TEMPLATES,
) -> int:
    """Number of (template, face) pairs of the searches that `run_scheme` makes for one scheme.

    The attacked templates meet all of the attacker's faces; those that the attacker lifts itself
    meet the nearby ones of the other folds. A pool's decoys and the search for guesses, a few
    per cent more, are left out, and so is the training.
    """
    plan = AttributePlan() if plan is None else plan
    gallery = min(plan.gallery_most, faces - faces // plan.folds)
    own = plan.lifts_of(faces) * min(plan.training_most, faces)
    return templates * faces + own * gallery


def measure_cost(
    *,
    n: int = PAPER_N,
    m: int = PAPER_M,
    faces: int = 4096,
    templates: int = 512,
    repeats: int = 3,
    seed: int = 0,
    plan: AttributePlan | None = None,
) -> SearchCost:
    """Time the neighbour search on random unit rows: it takes the same time on real faces.

    Parameters
    ----------
    faces, templates
        Size of the slice. Both are searched in tiles of these sizes at most, so that a larger
        slice costs as much a pair.
    repeats
        The least time counts, as whatever else the machine does only adds to it.
    plan
        Whose neighbours are searched for, on as many cores as it says.

    Raises
    ------
    AuditError
        A size is too small to be searched.
    """
    plan = AttributePlan() if plan is None else plan
    k, threads = plan.neighbours, plan.threads
    if min(templates, repeats) < 1 or faces < k:
        raise AuditError(f"the search is timed on {k} or more faces, one template, one repeat")
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((faces + templates, n)).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    batch = lift(
        rows[:templates], strategy=Strategy.RANDOM, m=m, stream=Keystream.seeded("cost", seed)
    )
    step = -(-templates // threads)
    parts = [batch[start : start + step] for start in range(0, templates, step)]
    spent = []
    with single_threaded(), ThreadPoolExecutor(threads) as pool:
        for _ in range(repeats):
            begun = time.perf_counter()
            for done in [
                pool.submit(nearest_neighbours, part, rows[templates:], k=k) for part in parts
            ]:
                done.result()
            spent.append(time.perf_counter() - begun)
    return SearchCost(n=n, m=m, k=k, threads=threads, pairs=faces * templates, seconds=min(spent))
