"""The verdict of a calibration: what a thief of a template gets, who is turned away or let in."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, TypeAlias

import numpy as np
from pydantic import Field, computed_field

from templates.contract.canonical import Json
from templates.contract.levels import Rate
from templates.contract.parsing import JsonValue

Status: TypeAlias = Literal["PASS", "FAIL", "NOT SHOWN"]
CONFIDENCE = 0.95
_BISECTIONS = 50

Limit = Annotated[float, Field(gt=0, lt=1)]


def upper_bound(errors: int, trials: int, *, confidence: float = CONFIDENCE) -> float:
    """One-sided upper bound of a proportion, after Clopper and Pearson; 1 where all went wrong.

    The share at which as few errors as were seen, or fewer, have the probability
    1 − ``confidence``.
    """
    if errors >= trials:
        return 1.0
    seen = np.arange(errors + 1)
    ways = np.append(0.0, np.cumsum(np.log((trials - seen[:-1]) / (seen[:-1] + 1))))
    low, high = errors / trials, 1.0
    for _ in range(_BISECTIONS):
        share = (low + high) / 2
        logs = ways + seen * math.log(share) + (trials - seen) * math.log1p(-share)
        low, high = (share, high) if np.exp(logs).sum() > 1 - confidence else (low, share)
    return high


@dataclass(frozen=True)
class Judgement(JsonValue):
    """A measured rate against its limit.

    Parameters
    ----------
    rate
        What was counted, with its interval.
    limit
        Most that passes.
    bound
        Most that the one-sided 95 % upper bound of the rate may be; None where it is not held
        against anything.
    basis
        What it was measured with: the strongest attack and its faces, or the level and photos.
    shortfall
        What the data were too few for, or the attacks do not cover, in a sentence; such a rate
        shows nothing.
    """

    what: ClassVar[str] = "a verdict"

    rate: Rate
    limit: Limit
    basis: Mapping[str, Json] = field(default_factory=dict)
    shortfall: str | None = None
    bound: Limit | None = None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def value(self) -> float:
        """The measured rate."""
        return self.rate.value

    @computed_field  # type: ignore[prop-decorator]
    @property
    def upper(self) -> float | None:
        """The one-sided 95 % upper bound of the rate; None without a bound to hold it against."""
        if self.bound is None:
            return None
        return round(upper_bound(self.rate.errors, self.rate.trials), 6)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def status(self) -> Status:
        """``PASS`` where the rate and its upper bound are within limits, and the data show it."""
        if self.shortfall is not None or not self.rate.trials:
            return "NOT SHOWN"
        if self.rate.value > self.limit:
            return "FAIL"
        upper, bound = self.upper, self.bound
        return "NOT SHOWN" if upper is not None and upper > (bound or 0.0) else "PASS"

    @property
    def close(self) -> bool:
        """Whether the rate is more than half of the limit, or nothing passes."""
        return self.status != "PASS" or self.rate.value > self.limit / 2


@dataclass(frozen=True)
class Verdict(JsonValue):
    """Whether a contract is private, whether it is accurate, and whether it is so for every group.

    Parameters
    ----------
    privacy
        Share of templates from which the strongest attacker gets a match for a fresh photo.
    accuracy
        False rejection rate of the default level, with the advised number of photos; None where
        nobody has two photos.
    groups
        False match rate of the default level within the group of people where it is highest; None
        where that was not measured.
    """

    what: ClassVar[str] = "the verdict"

    privacy: Judgement
    accuracy: Judgement | None = None
    groups: Judgement | None = None
