"""Templates of tests drawn of a seed.

At a false match rate of one in a hundred a stranger is accepted now and then, and a bound on a rate
is exceeded: drawn anew in each run, every such test would fail by chance once in a while.
"""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from templates.keys.randomness import Keystream


@contextmanager
def drawn_of(seed: str) -> Iterator[None]:
    """Draw all templates of this process of ``seed`` within the block, each of its own stream."""
    draws = itertools.count()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Keystream, "fresh", lambda: Keystream.seeded(seed, next(draws)))
        yield
