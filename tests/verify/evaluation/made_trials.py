"""Embeddings of made-up people, and pairs of them."""

import numpy as np

from templates.decoys import Attributes, DecoyPool
from tests.verify.synthetic import unit
from verify.evaluation.comparison import Trials
from verify.evaluation.verification_set import contiguous_folds

N = 24


def pool(entries: int = 120, *, n: int = N, labelled: bool = False, seed: int = 0) -> DecoyPool:
    generator = np.random.default_rng(seed)
    labels = None
    if labelled:
        labels = [
            Attributes("Male" if k % 2 else "Female", ("White", "Black", "Indian")[k % 3])
            for k in range(entries)
        ]
    return DecoyPool(unit(generator.normal(size=(entries, n))), labels=labels)


def made_trials(
    *, people: int = 30, pairs: int = 100, named: bool = True, spread: float = 0.15, seed: int = 0
) -> Trials:
    """Two photos of each person; genuine and impostor pairs in turn."""
    generator = np.random.default_rng(seed)
    centres = np.repeat(unit(generator.normal(size=(people, N))), 2, axis=0)
    rows = unit(centres + spread * generator.normal(size=centres.shape))
    same = np.arange(pairs) % 2 == 0
    first = generator.integers(people, size=pairs)
    second = np.where(same, first, (first + generator.integers(1, people, size=pairs)) % people)
    return Trials(
        name="made",
        embeddings=rows,
        first=(2 * first).astype(np.int64),
        second=(2 * second + 1).astype(np.int64),
        same=same,
        folds=contiguous_folds(pairs),
        people=np.stack([first, second]).astype(np.int64) if named else None,
        attributes=[
            Attributes("Male" if k % 4 < 2 else "Female", "White") for k in range(2 * people)
        ],
        sources=(pool(labelled=True),),
        kept=np.arange(pairs),
    )
