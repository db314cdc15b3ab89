"""What a calibration found: rates with their counts, levels, and the calibration itself."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field

from templates.contract.canonical import Json, digest
from templates.contract.parsing import JsonValue, Share
from templates.distances import Metric
from templates.errors import ContractError, Uncalibrated

Mode: TypeAlias = Literal["p2s", "s2s"]
Interval: TypeAlias = Literal["wilson", "subject-bootstrap"]

MAX_LEVELS = 8
MAX_PHOTOS = 10
MAX_PROBE_PHOTOS = 5
MAX_STEPS = 10_000
MAX_GROUPS = 64
"""Groups of people in a level, over all attributes."""
MAX_GROUP_NAME = 100
LEVEL_NAME = re.compile(r"[a-z0-9][a-z0-9.+-]{0,31}")

Count = Annotated[int, Field(ge=0)]
LevelName = Annotated[str, Field(pattern=f"^{LEVEL_NAME.pattern}$")]
Photos = Annotated[int, Field(ge=1, le=MAX_PHOTOS)]
GroupName = Annotated[str, Field(min_length=1, max_length=MAX_GROUP_NAME)]


def photos_in_words(count: int) -> str:
    """Return how many photos a probe is the mean of: ``one photo``, ``3 photos``."""
    return "one photo" if count == 1 else f"{count} photos"


@dataclass(frozen=True)
class Rate(JsonValue):
    """An error rate as it was counted, with its 95 % interval.

    Parameters
    ----------
    errors, trials
        Counts; ``0 <= errors <= trials``.
    ci_low, ci_high
        Bounds of the 95 % interval.
    interval
        How the bounds were computed: ``wilson`` takes trials as independent;
        ``subject-bootstrap`` resamples people, since trials share them.
    """

    what: ClassVar[str] = "a rate"

    errors: Count
    trials: Count
    ci_low: Share
    ci_high: Share
    interval: Interval = "wilson"

    def __post_init__(self) -> None:
        if self.errors > self.trials:
            raise ContractError("a rate counts more errors than trials")

    @property
    def value(self) -> float:
        """Errors over trials; 0 where nothing was tried."""
        return self.errors / self.trials if self.trials else 0.0


@dataclass(frozen=True)
class GroupRates(JsonValue):
    """Error rates within one group of people, at a level's threshold (ISO/IEC 19795-10).

    Parameters
    ----------
    attribute, group
        Such as ``gender`` and ``Female``: printable, at most ``MAX_GROUP_NAME`` characters.
    fmr
        Of impostor trials in which both people are in the group.
    frr
        Of the genuine probes of its people, those that are refused because their photos do not
        agree among the errors.
    fmr_judged, frr_judged
        Whether there were trials enough to judge the rate by.
    """

    what: ClassVar[str] = "the rates of a group"

    attribute: GroupName
    group: GroupName
    fmr: Rate
    frr: Rate
    fmr_judged: bool
    frr_judged: bool


def check_group_names(names: Iterable[str]) -> None:
    """Refuse a name of an attribute or a group that a terminal or a page could not show."""
    for name in names:
        if not 1 <= len(name) <= MAX_GROUP_NAME or not name.isprintable():
            raise ContractError(
                f"an attribute or a group needs a printable name of 1 to {MAX_GROUP_NAME} "
                "characters"
            )


@dataclass(frozen=True)
class Level(JsonValue):
    """A security level: its threshold, and the errors seen on the calibration data.

    A probe is accepted where its score reaches ``threshold``: the similarity less what is expected
    of this probe against templates of nobody, in units of its spread (docs/method.md "Scores").

    Parameters
    ----------
    name
        For example ``fmr-1e-3`` or ``accuracy``.
    target_fmr
        The false match rate that the threshold was chosen for; None for ``accuracy``, whose
        threshold is the ten-fold protocol's.
    threshold
        Least score that is accepted.
    fmr, fnmr
        Rates on the calibration data.
    fnmr_by_photos
        The FNMR of templates of one photo, of two …: of those that were tried.
    frr_by_photos
        As ``fnmr_by_photos``, of all genuine probes: those of several photos that are refused,
        because they do not agree, are rejected too. Empty where none was refused.
    groups
        Rates by group of people; empty where nobody was labelled.
    """

    what: ClassVar[str] = "a level"

    name: LevelName
    target_fmr: Annotated[float, Field(gt=0, le=0.5)] | None
    threshold: Annotated[float, Field(alias="score_threshold")]
    fmr: Rate
    fnmr: Rate
    fnmr_by_photos: Mapping[Photos, Rate] = field(default_factory=dict)
    frr_by_photos: Mapping[Photos, Rate] = field(default_factory=dict)
    groups: Annotated[tuple[GroupRates, ...], Field(max_length=MAX_GROUPS)] = ()

    @property
    def stated_fmr(self) -> float:
        """What a stranger reaches: the target, or without one the rate that was seen."""
        return self.fmr.value if self.target_fmr is None else self.target_fmr


@dataclass(frozen=True)
class Calibration(JsonValue):
    """Thresholds of one (mode, metric, probe m, probe photos) of a contract.

    Parameters
    ----------
    mode
        ``p2s``: the probe is a raw unit descriptor; ``s2s``: the probe is lifted.
    metric
        The distance that decides.
    probe_m
        Dimension of the lifted probe; 0 in ``p2s``.
    probe_photos
        Photos of one person that a probe is the mean of; 1 in ``s2s``.
    steps
        Steps of the spherical s-to-s iteration: calibration and service must see equal numbers.
    levels
        Ordered from lax to strict.
    foot_point_norm
        Range of ‖p‖ that an honest lifted probe has; None in ``p2s``.
    calibrated_on
        What was measured: data, people, counts, protocol, seed; how the levels were set.
    calibration_id
        SHA-256 of all of the above and the contract id; empty until ``identified``.
    """

    what: ClassVar[str] = "a calibration"

    mode: Mode
    metric: Metric
    probe_m: Annotated[int, Field(ge=0, le=4096)]
    steps: Annotated[int, Field(ge=1, le=MAX_STEPS)]
    levels: Annotated[tuple[Level, ...], Field(min_length=1, max_length=MAX_LEVELS)]
    foot_point_norm: tuple[Share, Share] | None
    calibrated_on: Mapping[str, Json] = field(default_factory=dict)
    probe_photos: Annotated[int, Field(ge=1, le=MAX_PROBE_PHOTOS)] = 1
    calibration_id: str = ""

    def __post_init__(self) -> None:
        if len({level.name for level in self.levels}) < len(self.levels):
            raise ContractError("two levels of a calibration bear one name")

    def level(self, name: str) -> Level:
        """Find a level by name.

        Raises
        ------
        Uncalibrated
            Where the calibration data could not resolve that level.
        """
        for level in self.levels:
            if level.name == name:
                return level
        if self.mode == "s2s":
            probe = f"a lifted probe with m = {self.probe_m}"
        else:
            probe = photos_in_words(self.probe_photos)
        raise Uncalibrated(
            f"the contract has no such level for {probe}: choose one of "
            + ", ".join(level.name for level in self.levels)
        )

    def identified(self, contract_id: str) -> "Calibration":
        """Compute the id for one contract."""
        body = self.to_json()
        del body["calibration_id"]
        bound = {"calibration": body, "contract_id": contract_id}
        return replace(self, calibration_id=digest(bound))
