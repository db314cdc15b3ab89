"""An attack as its file declares it: what it breaks, what it takes, and what it yields.

A new attack is one function in a file of ``attacks/stored``, which says by :func:`attack` what it
breaks and what it takes. Its docstring is the assumption that the report prints. It yields guesses
of embeddings, probes to present, or scores of two templates.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from attacks.bed import Pairs, Testbed
from attacks.outcomes import AttackOutcome, Knowledge, Property
from templates.contract.canonical import Json
from verify.cohort import Probes as Sent


@dataclass(frozen=True, eq=False, repr=False)
class Guesses:
    """Guesses of the embeddings that templates hide; success is a match with a fresh photo.

    Parameters
    ----------
    points : (V, k) floating
        One for each victim; their length does not matter. A zero row is a failure.
    variant
        What distinguishes them from the other guesses of the attack.
    people
        Who was attacked instead of the bed's victims.
    details
        Further figures for the report.
    unjudged
        Why the verdict does not count them.
    """

    points: NDArray[np.floating]
    variant: str = ""
    people: Pairs | None = None
    details: Mapping[str, Json] = field(default_factory=dict)
    unjudged: str | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Probes:
    """What the attacker sends, one for each victim or one for all; success is acceptance.

    ``sent`` are (V, k) or (1, k) float32, or lifted probes of the contract's dimension.
    """

    sent: Sent
    variant: str = ""


@dataclass(frozen=True, eq=False, repr=False)
class LinkScores:
    """Of template i of one batch with template j of the other, (V, V): more where one person is."""

    values: NDArray[np.float64]


Result: TypeAlias = Guesses | Probes | LinkScores


@dataclass(frozen=True)
class Attack:
    """An attack that the runner knows; see :func:`attack`."""

    run: Callable[[Testbed], Iterable[Result]]
    breaks: Property
    needs: Knowledge

    @property
    def name(self) -> str:
        """Name of the attack in reports: that of its function."""
        return str(getattr(self.run, "__name__", "")).replace("_", "-")

    @property
    def assumption(self) -> str:
        """What the attacker does, in a sentence."""
        return " ".join((self.run.__doc__ or "").split("\n\n")[0].split())

    def row(self, bed: Testbed, **fields: object) -> AttackOutcome:
        """Return a row of the report, with what every row of the attack says."""
        common = {
            "attack": self.name,
            "breaks": self.breaks,
            "knowledge": self.needs.level(bed.scheme),
            "assumption": self.assumption,
            "scheme": bed.scheme,
        }
        return AttackOutcome(**(common | fields))  # type: ignore[arg-type]


def attack(
    *, breaks: Property, needs: Knowledge
) -> Callable[[Callable[[Testbed], Iterable[Result]]], Attack]:
    """Declare a function of a test bed to be an attack: what it breaks, and what it takes."""
    return partial(Attack, breaks=breaks, needs=needs)
