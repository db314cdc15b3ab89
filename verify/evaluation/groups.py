"""Error rates by group of people, at the one threshold that holds for all (ISO/IEC 19795-10).

A genuine trial belongs to the group that both photos are labelled with; an impostor trial counts
for a group's FMR where both people are in it, and as a cross trial where they are in two.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from verify.metrics import resolvable, wilson

MIN_GENUINE = 100
"""Genuine trials below which a group is listed and not judged: one error is more than 1 %."""
_LEVEL = 0.05


def least_of_highest(errors: float, trials: int, *, groups: int) -> float:
    """Lower bound of the highest of so many groups' rates: Wilson's at 1 − 0.05 / groups.

    The highest of several rates is above by chance alone more often than one that was named
    beforehand (Bonferroni). `evaluate` and the verdict of a calibration judge by this bound.
    """
    return wilson(errors, trials, confidence=1 - _LEVEL / groups)[0]


@dataclass(frozen=True)
class MeanRate:
    """An error rate over one or several runs on the same trials.

    Parameters
    ----------
    errors
        Mean over the runs of the errors of one run; a whole number where there was one run.
    trials
        Trials of one run.
    ci_low, ci_high
        Wilson's 95 % interval for these errors in the trials of *one* run. Further runs lift the
        same photos anew, which tells nothing about further people: they do not narrow it. It takes
        trials as independent; people who are in several of them make it too narrow.
    """

    errors: float
    trials: int
    ci_low: float
    ci_high: float

    @property
    def value(self) -> float | None:
        """Errors over trials; None where nothing was tried."""
        return self.errors / self.trials if self.trials else None

    def json(self) -> dict[str, float | int | None]:
        """JSON form."""
        return {"value": self.value, **asdict(self)}


@dataclass(frozen=True)
class Group:
    """Rates of one group.

    Parameters
    ----------
    fmr, fnmr
        Of impostor trials within the group, and of its genuine trials.
    fmr_judged, fnmr_judged
        Whether there are trials enough to compare the rate with other groups': for the FMR
        :func:`fmr_judged`, for the FNMR ``MIN_GENUINE``.
    """

    name: str
    fmr: MeanRate
    fnmr: MeanRate
    fmr_judged: bool
    fnmr_judged: bool


@dataclass(frozen=True)
class Worst:
    """The judged group with the highest rate.

    Parameters
    ----------
    apart
        Whether the group's interval lies wholly above the rate of all groups together. The
        interval is Wilson's at 1 − 0.05 / k for k judged groups: the highest of k rates is above
        by chance alone more often than one that was named beforehand.
    """

    group: str
    rate: MeanRate
    apart: bool

    def json(self) -> dict[str, object]:
        """JSON form."""
        return {"group": self.group, "apart": self.apart, **self.rate.json()}


@dataclass(frozen=True)
class GroupReport:
    """Results by one attribute, at one threshold.

    Parameters
    ----------
    target_fmr
        The target of the threshold on all impostor trials.
    threshold
        Similarity; the mean over the runs.
    groups
        In the order of their names; ages in the order of years.
    cross_fmr
        Over impostor trials of two people of two groups.
    mixed
        Genuine trials whose photos have two labels (age, or a fault of the labels).
    unlabelled_genuine, unlabelled_impostor
        Trials with a photo without a label.
    worst_fmr, worst_fnmr
        None where fewer than two groups are judged, or none of them has an error.
    fmr_ratio, fnmr_ratio
        Highest rate of the judged groups over their geometric mean, the measure of inequity of
        ISO/IEC 19795-10 and of NIST's FRVT (IR 8429); None where fewer than two groups are judged
        or one of them has no error, as the mean is then 0.
    """

    attribute: str
    target_fmr: float
    threshold: float
    runs: int
    groups: tuple[Group, ...]
    overall_fmr: MeanRate
    overall_fnmr: MeanRate
    pooled_fmr: MeanRate
    pooled_fnmr: MeanRate
    cross_fmr: MeanRate
    mixed: int
    unlabelled_genuine: int
    unlabelled_impostor: int
    worst_fmr: Worst | None
    worst_fnmr: Worst | None
    fmr_ratio: float | None
    fnmr_ratio: float | None

    def json(self) -> list[dict[str, object]]:
        """One plain dict per group, for ``groups`` of ``results.json``."""
        return [
            {
                "attribute": self.attribute,
                "group": group.name,
                "target_fmr": self.target_fmr,
                "threshold": self.threshold,
                "runs": self.runs,
                "fmr": {**group.fmr.json(), "judged": group.fmr_judged},
                "fnmr": {**group.fnmr.json(), "judged": group.fnmr_judged},
            }
            for group in self.groups
        ]

    def summary(self) -> dict[str, object]:
        """What concerns all groups, as a plain dict."""
        return {
            "attribute": self.attribute,
            "target_fmr": self.target_fmr,
            "threshold": self.threshold,
            "runs": self.runs,
            "overall_fmr": self.overall_fmr.json(),
            "overall_fnmr": self.overall_fnmr.json(),
            "pooled_fmr": self.pooled_fmr.json(),
            "pooled_fnmr": self.pooled_fnmr.json(),
            "cross_fmr": self.cross_fmr.json(),
            "mixed": self.mixed,
            "unlabelled_genuine": self.unlabelled_genuine,
            "unlabelled_impostor": self.unlabelled_impostor,
            "worst_fmr": None if self.worst_fmr is None else self.worst_fmr.json(),
            "worst_fnmr": None if self.worst_fnmr is None else self.worst_fnmr.json(),
            "fmr_ratio": self.fmr_ratio,
            "fnmr_ratio": self.fnmr_ratio,
        }


def by_group(
    similarities: Sequence[NDArray[np.floating]],
    same: NDArray[np.bool_],
    first_labels: Sequence[str | None],
    second_labels: Sequence[str | None],
    *,
    attribute: str,
    thresholds: Sequence[float],
    target_fmr: float,
) -> GroupReport:
    """Count the errors of each group.

    Parameters
    ----------
    similarities
        Of one or several runs, each (P,), on the same pairs; no failed pair among them.
    same : (P,) bool
        Whether a pair shows one person.
    first_labels, second_labels
        Label of each photo of each pair, None where it has none.
    thresholds
        The threshold of each run, set on all its trials; a pair at or above it matches.

    Raises
    ------
    ValueError
        Where lengths differ, a similarity is not finite, or the target is not in (0, 1).
    """
    scores = [np.asarray(run, dtype=np.float64) for run in similarities]
    lengths = {len(same), len(first_labels), len(second_labels), *map(len, scores)}
    if len(lengths) > 1 or not scores or len(scores) != len(thresholds):
        raise ValueError("groups need runs on the same labelled pairs, with a threshold each")
    if not all(np.isfinite(run).all() for run in scores) or not 0 < target_fmr < 1:
        raise ValueError("groups need finite similarities and a target in (0, 1)")
    wrong = np.zeros(len(same), dtype=np.int64)
    for run, limit in zip(scores, thresholds, strict=True):
        wrong += (run >= limit) != same

    def counted(trials: NDArray[np.bool_]) -> MeanRate:
        errors = int(wrong[trials].sum()) / len(scores)
        count = int(np.count_nonzero(trials))
        return MeanRate(errors, count, *wilson(errors, count))

    names = sorted({*first_labels, *second_labels} - {None}, key=in_order)
    number = {name: place for place, name in enumerate(names)}
    first = np.array([number.get(label, -1) for label in first_labels], dtype=np.int64)
    second = np.array([number.get(label, -1) for label in second_labels], dtype=np.int64)
    labelled = (first >= 0) & (second >= 0)
    together = labelled & (first == second)
    groups = []
    for place, name in enumerate(names):
        fmr = counted(~same & together & (first == place))
        fnmr = counted(same & together & (first == place))
        enough = fmr_judged(fmr.trials, target_fmr), fnmr.trials >= MIN_GENUINE
        groups.append(Group(str(name), fmr, fnmr, *enough))
    pooled_fmr, pooled_fnmr = counted(~same & together), counted(same & together)
    judged_fmr = [(group.name, group.fmr) for group in groups if group.fmr_judged]
    judged_fnmr = [(group.name, group.fnmr) for group in groups if group.fnmr_judged]
    return GroupReport(
        attribute=attribute,
        target_fmr=target_fmr,
        threshold=float(np.mean(thresholds)),
        runs=len(scores),
        groups=tuple(groups),
        overall_fmr=counted(~same),
        overall_fnmr=counted(same),
        pooled_fmr=pooled_fmr,
        pooled_fnmr=pooled_fnmr,
        cross_fmr=counted(~same & labelled & ~together),
        mixed=int(np.count_nonzero(same & labelled & ~together)),
        unlabelled_genuine=int(np.count_nonzero(same & ~labelled)),
        unlabelled_impostor=int(np.count_nonzero(~same & ~labelled)),
        worst_fmr=_worst(judged_fmr, pooled_fmr),
        worst_fnmr=_worst(judged_fnmr, pooled_fnmr),
        fmr_ratio=_ratio([rate for _, rate in judged_fmr]),
        fnmr_ratio=_ratio([rate for _, rate in judged_fnmr]),
    )


def fmr_judged(trials: int, target: float) -> bool:
    """Whether a group has 1 / target impostor trials: in fewer, one error exceeds the target."""
    return resolvable(target, trials, expected_errors=1)


def in_order(name: str | None) -> tuple[float, str]:
    """Sort key of labels: ages in the order of years, others by the alphabet."""
    years = re.match(r"\d+", str(name))
    return (float(years.group()) if years else math.inf, str(name))


def _worst(judged: Sequence[tuple[str, MeanRate]], pooled: MeanRate) -> Worst | None:
    if len(judged) < 2 or all(rate.errors == 0 for _, rate in judged):
        return None
    # Of equal rates the one with more trials is named: it is known best.
    name, rate = max(judged, key=lambda entry: (entry[1].value or 0.0, entry[1].trials))
    low = least_of_highest(rate.errors, rate.trials, groups=len(judged))
    return Worst(group=name, rate=rate, apart=low > (pooled.value or 0.0))


def _ratio(judged: Sequence[MeanRate]) -> float | None:
    values = [rate.value or 0.0 for rate in judged]
    if len(values) < 2 or min(values) == 0:
        return None
    return float(max(values) / math.exp(np.mean(np.log(values))))
