"""What a calibration found: rates with their counts, levels, and the calibration itself."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal, TypeAlias, get_args

from pydantic import Field

from templates.contract.canonical import Json, digest, free_object
from templates.contract.parsing import JsonValue
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
SHA256_HEX = re.compile(r"[0-9a-f]{64}")


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

    errors: int
    trials: int
    ci_low: float
    ci_high: float
    interval: Interval = "wilson"

    def __post_init__(self) -> None:
        if not 0 <= self.errors <= self.trials:
            raise ContractError("a rate needs 0 <= errors <= trials")
        if not 0.0 <= self.ci_low <= self.ci_high <= 1.0:
            raise ContractError("a rate's interval must be ordered and inside [0, 1]")
        if self.interval not in get_args(Interval):
            raise ContractError(f"a rate's interval must be one of {get_args(Interval)}")

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

    attribute: str
    group: str
    fmr: Rate
    frr: Rate
    fmr_judged: bool
    frr_judged: bool

    def __post_init__(self) -> None:
        check_group_names((self.attribute, self.group))


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

    name: str
    target_fmr: float | None
    threshold: Annotated[float, Field(alias="score_threshold")]
    fmr: Rate
    fnmr: Rate
    fnmr_by_photos: Mapping[int, Rate] = field(default_factory=dict)
    frr_by_photos: Mapping[int, Rate] = field(default_factory=dict)
    groups: tuple[GroupRates, ...] = ()

    def __post_init__(self) -> None:
        if not LEVEL_NAME.fullmatch(self.name):
            raise ContractError("a level's name must match " + LEVEL_NAME.pattern)
        if self.target_fmr is not None and not 0.0 < self.target_fmr <= 0.5:
            raise ContractError("a level's target FMR must lie in (0, 0.5]")
        if not math.isfinite(self.threshold):
            raise ContractError("a level's threshold is not a finite number")
        enrolled = {*self.fnmr_by_photos, *self.frr_by_photos}
        if not all(1 <= photos <= MAX_PHOTOS for photos in enrolled):
            raise ContractError(f"a template is made of 1 to {MAX_PHOTOS} photos")
        named = {(entry.attribute, entry.group) for entry in self.groups}
        if len(self.groups) > MAX_GROUPS or len(named) != len(self.groups):
            raise ContractError(f"a level has at most {MAX_GROUPS} groups, each of them once")

    def to_json(self) -> dict[str, Json]:
        """JSON form; without ``frr_by_photos`` and ``groups`` where they are empty."""
        value = super().to_json()
        value["score_threshold"] = value.pop("threshold")
        for name in ("frr_by_photos", "groups"):
            if not value[name]:
                del value[name]
        return value


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
    probe_m: int
    steps: int
    levels: tuple[Level, ...]
    foot_point_norm: tuple[float, float] | None
    calibrated_on: Mapping[str, Json] = field(default_factory=dict)
    probe_photos: int = 1
    calibration_id: str = ""

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ContractError("a calibration's mode must be p2s or s2s")
        if (self.mode == "p2s") != (self.probe_m == 0) or not 0 <= self.probe_m <= 4096:
            raise ContractError("a calibration's probe m must be 0 in p2s and 1 or more in s2s")
        if not 1 <= self.probe_photos <= (MAX_PROBE_PHOTOS if self.mode == "p2s" else 1):
            raise ContractError(
                f"a probe is of 1 to {MAX_PROBE_PHOTOS} photos in p2s, and of 1 in s2s"
            )
        if (self.mode == "p2s") != (self.foot_point_norm is None):
            raise ContractError("a calibration has a range of foot-point norms exactly in s2s")
        if self.foot_point_norm is not None:
            check_norm_range(self.foot_point_norm)
        if not 1 <= self.steps <= MAX_STEPS:
            raise ContractError(f"a calibration's steps must lie in 1 to {MAX_STEPS}")
        names = [level.name for level in self.levels]
        if not names or len(names) > MAX_LEVELS or len(set(names)) != len(names):
            raise ContractError(f"a calibration needs 1 to {MAX_LEVELS} levels of distinct names")
        # At most five calibrations are of raw probes, which bounds the values in a contract.
        if self.mode == "s2s" and any(level.groups for level in self.levels):
            raise ContractError("rates by group are of raw probes")
        if self.probe_photos == 1 and any(level.frr_by_photos for level in self.levels):
            raise ContractError("one photo cannot disagree: its FRR is its FNMR")
        facts = free_object(self.calibrated_on, what="what a calibration was calibrated on")
        object.__setattr__(self, "calibrated_on", facts)
        object.__setattr__(self, "metric", Metric(self.metric))

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
        body: dict[str, Json] = self.to_json()
        del body["calibration_id"]
        bound: dict[str, Json] = {"calibration": body, "contract_id": contract_id}
        return replace(self, calibration_id=digest(bound))


def check_norm_range(norms: tuple[float, float]) -> None:
    """Refuse a range that is not ordered inside [0, 1]."""
    low, high = norms
    if not 0.0 <= low < high <= 1.0:
        raise ContractError("a range of foot-point norms must be ordered and inside [0, 1]")
