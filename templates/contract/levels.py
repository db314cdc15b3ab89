"""What a calibration found: rates with their counts, levels, and the calibration itself."""

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, cast, get_args

from templates.contract.canonical import Fields, Json, digest, free_object
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
class Rate:
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

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "errors": self.errors,
            "trials": self.trials,
            "ci_low": self.ci_low,
            "ci_high": self.ci_high,
            "interval": self.interval,
        }

    @classmethod
    def from_json(cls, value: object) -> "Rate":
        """Parse hostile JSON."""
        fields = Fields(value, what="a rate")
        rate = cls(
            errors=fields.integer("errors"),
            trials=fields.integer("trials"),
            ci_low=fields.number("ci_low"),
            ci_high=fields.number("ci_high"),
            interval=cast(Interval, fields.text("interval")),
        )
        fields.done()
        return rate


@dataclass(frozen=True)
class GroupRates:
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

    attribute: str
    group: str
    fmr: Rate
    frr: Rate
    fmr_judged: bool
    frr_judged: bool

    def __post_init__(self) -> None:
        check_group_names((self.attribute, self.group))

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "attribute": self.attribute,
            "group": self.group,
            "fmr": self.fmr.to_json(),
            "frr": self.frr.to_json(),
            "fmr_judged": self.fmr_judged,
            "frr_judged": self.frr_judged,
        }

    @classmethod
    def from_json(cls, value: object) -> "GroupRates":
        """Parse hostile JSON."""
        fields = Fields(value, what="the rates of a group")
        rates = cls(
            attribute=fields.text("attribute"),
            group=fields.text("group"),
            fmr=Rate.from_json(fields.take("fmr")),
            frr=Rate.from_json(fields.take("frr")),
            fmr_judged=fields.boolean("fmr_judged"),
            frr_judged=fields.boolean("frr_judged"),
        )
        fields.done()
        return rates


def check_group_names(names: Iterable[str]) -> None:
    """Refuse a name of an attribute or a group that a terminal or a page could not show."""
    for name in names:
        if not 1 <= len(name) <= MAX_GROUP_NAME or not name.isprintable():
            raise ContractError(
                f"an attribute or a group needs a printable name of 1 to {MAX_GROUP_NAME} "
                "characters"
            )


@dataclass(frozen=True)
class Level:
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

    name: str
    target_fmr: float | None
    threshold: float
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
        value: dict[str, Json] = {
            "name": self.name,
            "target_fmr": self.target_fmr,
            "score_threshold": self.threshold,
            "fmr": self.fmr.to_json(),
            "fnmr": self.fnmr.to_json(),
            "fnmr_by_photos": _json_by_photos(self.fnmr_by_photos),
        }
        if self.frr_by_photos:
            value["frr_by_photos"] = _json_by_photos(self.frr_by_photos)
        if self.groups:
            value["groups"] = [entry.to_json() for entry in self.groups]
        return value

    @classmethod
    def from_json(cls, value: object) -> "Level":
        """Parse hostile JSON."""
        fields = Fields(value, what="a level")
        groups = [] if fields.lacks("groups") else fields.items("groups", most=MAX_GROUPS)
        level = cls(
            name=fields.text("name"),
            target_fmr=None if fields.take_null("target_fmr") else fields.number("target_fmr"),
            threshold=fields.number("score_threshold"),
            fmr=Rate.from_json(fields.take("fmr")),
            fnmr=Rate.from_json(fields.take("fnmr")),
            fnmr_by_photos=_rates_by_photos(fields, "fnmr_by_photos"),
            frr_by_photos={}
            if fields.lacks("frr_by_photos")
            else _rates_by_photos(fields, "frr_by_photos"),
            groups=tuple(map(GroupRates.from_json, groups)),
        )
        fields.done()
        return level


def _json_by_photos(rates: Mapping[int, Rate]) -> dict[str, Json]:
    return {str(photos): rate.to_json() for photos, rate in rates.items()}


def _rates_by_photos(fields: Fields, key: str) -> dict[int, Rate]:
    value = fields.take(key)
    if not isinstance(value, dict) or not all(re.fullmatch("[1-9]|10", name) for name in value):
        raise ContractError(f"{key} is not an object whose keys are numbers of photos")
    return {int(photos): Rate.from_json(rate) for photos, rate in value.items()}


@dataclass(frozen=True)
class Calibration:
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

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "mode": self.mode,
            "metric": str(self.metric),
            "probe_m": self.probe_m,
            "probe_photos": self.probe_photos,
            "steps": self.steps,
            "levels": [level.to_json() for level in self.levels],
            "foot_point_norm": list(self.foot_point_norm) if self.foot_point_norm else None,
            "calibrated_on": dict(self.calibrated_on),
            "calibration_id": self.calibration_id,
        }

    @classmethod
    def from_json(cls, value: object) -> "Calibration":
        """Parse hostile JSON; the contract recomputes the id."""
        fields = Fields(value, what="a calibration")
        norms = fields.take("foot_point_norm")
        metric = fields.text("metric")
        if metric not in list(Metric):
            raise ContractError(f"a calibration's metric must be one of {[*map(str, Metric)]}")
        calibration = cls(
            mode=cast(Mode, fields.text("mode")),
            metric=Metric(metric),
            probe_m=fields.integer("probe_m"),
            probe_photos=fields.integer("probe_photos"),
            steps=fields.integer("steps"),
            levels=tuple(map(Level.from_json, fields.items("levels", most=MAX_LEVELS))),
            foot_point_norm=None if norms is None else norm_range(norms),
            calibrated_on=fields.free("calibrated_on"),
            calibration_id=fields.text("calibration_id"),
        )
        fields.done()
        return calibration


def norm_range(value: object) -> tuple[float, float]:
    """Parse a range of foot-point norms from hostile JSON."""
    low, high = Fields({"range": value}, what="a range of foot-point norms").numbers("range", 2)
    check_norm_range((low, high))
    return low, high


def check_norm_range(norms: tuple[float, float]) -> None:
    """Refuse a range that is not ordered inside [0, 1]."""
    low, high = norms
    if not 0.0 <= low < high <= 1.0:
        raise ContractError("a range of foot-point norms must be ordered and inside [0, 1]")
