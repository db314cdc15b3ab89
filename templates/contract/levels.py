"""What a calibration found: rates with their counts, levels, and the calibration itself."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias, cast, get_args

from templates.contract.canonical import Fields, Json, digest, free_object
from templates.distances import Metric
from templates.errors import ContractError, Uncalibrated

Mode: TypeAlias = Literal["p2s", "s2s"]
Interval: TypeAlias = Literal["wilson", "subject-bootstrap"]

MAX_LEVELS = 16
MAX_STEPS = 10_000
LEVEL_NAME = re.compile(r"[a-z0-9][a-z0-9.+-]{0,31}")
SHA256_HEX = re.compile(r"[0-9a-f]{64}")


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
class Level:
    """A security level: both thresholds, and the errors seen on the calibration data.

    A probe is accepted where its similarity reaches ``similarity_threshold`` *and* its cohort
    score reaches ``cohort_threshold`` (docs/method.md §6). The rates are those of this joint
    decision.

    Parameters
    ----------
    name
        For example ``fmr-1e-3`` or ``accuracy``.
    target_fmr
        The false match rate that the thresholds were chosen for; None for ``accuracy``, whose
        similarity threshold is the ten-fold protocol's.
    similarity_threshold
        On the scale of ``templates.distances.similarity``.
    cohort_threshold
        In standard deviations of the probe's similarities to the cohort.
    fmr, fnmr
        Joint rates on the calibration data.
    """

    name: str
    target_fmr: float | None
    similarity_threshold: float
    cohort_threshold: float
    fmr: Rate
    fnmr: Rate

    def __post_init__(self) -> None:
        if not LEVEL_NAME.fullmatch(self.name):
            raise ContractError("a level's name must match " + LEVEL_NAME.pattern)
        if self.target_fmr is not None and not 0.0 < self.target_fmr <= 0.5:
            raise ContractError("a level's target FMR must lie in (0, 0.5]")

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "name": self.name,
            "target_fmr": self.target_fmr,
            "similarity_threshold": self.similarity_threshold,
            "cohort_threshold": self.cohort_threshold,
            "fmr": self.fmr.to_json(),
            "fnmr": self.fnmr.to_json(),
        }

    @classmethod
    def from_json(cls, value: object) -> "Level":
        """Parse hostile JSON."""
        fields = Fields(value, what="a level")
        target = fields.take("target_fmr")
        level = cls(
            name=fields.text("name"),
            target_fmr=None
            if target is None
            else Fields({"t": target}, what="a level").number("t"),
            similarity_threshold=fields.number("similarity_threshold"),
            cohort_threshold=fields.number("cohort_threshold"),
            fmr=Rate.from_json(fields.take("fmr")),
            fnmr=Rate.from_json(fields.take("fnmr")),
        )
        fields.done()
        return level


@dataclass(frozen=True)
class Calibration:
    """Thresholds of one (mode, metric, probe m) of a contract.

    Parameters
    ----------
    mode
        ``p2s``: the probe is a raw unit descriptor; ``s2s``: the probe is lifted.
    metric
        The distance that decides.
    probe_m
        Dimension of the lifted probe; 0 in ``p2s``.
    steps
        Steps of the spherical s-to-s iteration: calibration and service must see equal numbers.
    levels
        Ordered from lax to strict.
    foot_point_norm
        Range of ‖p‖ that an honest lifted probe has; None in ``p2s``.
    calibrated_on
        What was measured: data, people, counts, protocol, seed.
    calibration_id
        SHA-256 of all of the above, the contract id and the cohort id; empty until ``identified``.
    """

    mode: Mode
    metric: Metric
    probe_m: int
    steps: int
    levels: tuple[Level, ...]
    foot_point_norm: tuple[float, float] | None
    calibrated_on: Mapping[str, Json] = field(default_factory=dict)
    calibration_id: str = ""

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise ContractError("a calibration's mode must be p2s or s2s")
        if (self.mode == "p2s") != (self.probe_m == 0) or not 0 <= self.probe_m <= 4096:
            raise ContractError("a calibration's probe m must be 0 in p2s and 1 or more in s2s")
        if (self.mode == "p2s") != (self.foot_point_norm is None):
            raise ContractError("a calibration has a range of foot-point norms exactly in s2s")
        if self.foot_point_norm is not None:
            check_norm_range(self.foot_point_norm)
        if not 1 <= self.steps <= MAX_STEPS:
            raise ContractError(f"a calibration's steps must lie in 1 to {MAX_STEPS}")
        names = [level.name for level in self.levels]
        if not names or len(names) > MAX_LEVELS or len(set(names)) != len(names):
            raise ContractError(f"a calibration needs 1 to {MAX_LEVELS} levels of distinct names")
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
        raise Uncalibrated(
            f"no level of the requested name for {self.mode} {self.metric} with probe m = "
            f"{self.probe_m}; calibrated are: {', '.join(level.name for level in self.levels)}"
        )

    def identified(self, *, contract_id: str, cohort_id: str) -> "Calibration":
        """Compute the id for one contract and one cohort."""
        body: dict[str, Json] = self.to_json()
        del body["calibration_id"]
        bound = {"calibration": body, "contract_id": contract_id, "cohort_id": cohort_id}
        return replace(self, calibration_id=digest(bound))

    def to_json(self) -> dict[str, Json]:
        """JSON form."""
        return {
            "mode": self.mode,
            "metric": str(self.metric),
            "probe_m": self.probe_m,
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
