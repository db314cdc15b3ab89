"""The verdict of a calibration: what a thief of a template gets, who is turned away or let in."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from templates.contract.canonical import Fields, Json, free_object
from templates.contract.levels import Rate
from templates.errors import ContractError

Status: TypeAlias = Literal["PASS", "FAIL"]


@dataclass(frozen=True)
class Judgement:
    """A measured rate against its limit.

    Parameters
    ----------
    rate
        What was counted, with its interval.
    limit
        Most that passes. The measured rate is compared, not the end of its interval.
    basis
        What it was measured with: the strongest attack and its faces, or the level and photos.
    shortfall
        What the data were too few for, or the attacks do not cover, in a sentence; such a rate
        shows nothing, and does not pass.
    """

    rate: Rate
    limit: float
    basis: Mapping[str, Json] = field(default_factory=dict)
    shortfall: str | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.limit < 1.0:
            raise ContractError("the limit of a verdict must lie between 0 and 1")
        if not self.rate.trials:
            raise ContractError("a verdict without a trial says nothing")
        object.__setattr__(self, "basis", free_object(self.basis, what="the basis of a verdict"))

    @property
    def status(self) -> Status:
        """``PASS`` where the measured rate is at most the limit, and shows something."""
        return "PASS" if self.shortfall is None and self.rate.value <= self.limit else "FAIL"

    @property
    def close(self) -> bool:
        """Whether the rate is more than half of the limit, or nothing passes."""
        return self.status == "FAIL" or self.rate.value > self.limit / 2

    def to_json(self) -> dict[str, Json]:
        """JSON form; ``status`` and ``value`` are there for readers, and follow from the rest."""
        return {
            "status": self.status,
            "value": self.rate.value,
            "limit": self.limit,
            "rate": self.rate.to_json(),
            "basis": dict(self.basis),
            "shortfall": self.shortfall,
        }

    @classmethod
    def from_json(cls, value: object) -> "Judgement":
        """Parse hostile JSON."""
        fields = Fields(value, what="a verdict")
        judgement = cls(
            rate=Rate.from_json(fields.take("rate")),
            limit=fields.number("limit"),
            basis=fields.free("basis"),
            shortfall=None if fields.take_null("shortfall") else fields.text("shortfall"),
        )
        if fields.text("status") != judgement.status:
            raise ContractError("a verdict's status does not follow from its rate and limit")
        if fields.number("value") != judgement.rate.value:
            raise ContractError("a verdict's value is not that of its rate")
        fields.done()
        return judgement


@dataclass(frozen=True)
class Verdict:
    """Whether a contract is private, whether it is accurate, and whether it is so for every group.

    Parameters
    ----------
    privacy
        Share of templates from which the strongest attacker gets a match for a fresh photo.
    accuracy
        False rejection rate of the default level, with the advised number of photos.
    groups
        False match rate of the default level within the group of people where it is highest; None
        where that was not measured.
    """

    privacy: Judgement
    accuracy: Judgement
    groups: Judgement | None = None

    def to_json(self) -> dict[str, Json]:
        """JSON form; without ``groups`` where they were not measured, as in older files."""
        value: dict[str, Json] = {
            "privacy": self.privacy.to_json(),
            "accuracy": self.accuracy.to_json(),
        }
        if self.groups is not None:
            value["groups"] = self.groups.to_json()
        return value

    @classmethod
    def from_json(cls, value: object) -> "Verdict":
        """Parse hostile JSON."""
        fields = Fields(value, what="the verdict")
        unmeasured = fields.lacks("groups")
        verdict = cls(
            privacy=Judgement.from_json(fields.take("privacy")),
            accuracy=Judgement.from_json(fields.take("accuracy")),
            groups=None if unmeasured else Judgement.from_json(fields.take("groups")),
        )
        fields.done()
        return verdict
