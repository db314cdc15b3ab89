"""Error rates by group of people, at the one threshold that holds for all (ISO/IEC 19795-10).

A genuine trial belongs to the group that both photos are labelled with; an impostor trial counts
for a group's FMR where both people are in it.
"""

import math
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from verify.evaluation.plan import Json
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


def mean_rate(errors: float, trials: int) -> Json:
    """Mean errors of one run over its trials, with Wilson's 95 % interval for *one* run.

    Further runs lift the same photos anew, which tells nothing about further people: they do not
    narrow it. It takes trials as independent; people who are in several make it too narrow.
    """
    low, high = wilson(errors, trials)
    value = errors / trials if trials else None
    return {"value": value, "errors": errors, "trials": trials, "ci_low": low, "ci_high": high}


def by_group(
    similarities: Sequence[NDArray[np.floating]],
    same: NDArray[np.bool_],
    first_labels: Sequence[str | None],
    second_labels: Sequence[str | None],
    *,
    attribute: str,
    thresholds: Sequence[float],
    target_fmr: float,
) -> tuple[list[Json], Json]:
    """Count the errors of each group, over one or several runs on the same pairs.

    Returns the groups' ``fmr`` and ``fnmr``, ages in the order of years, and a summary. ``judged``
    says whether a rate has trials enough to be compared: for the FMR :func:`fmr_judged`, for the
    FNMR ``MIN_GENUINE``. The summary has the rates of all trials within a group (``pooled``); the
    number of others (``without_common_label``); the ``worst`` judged group, ``apart`` where its
    interval (at 1 − 0.05 / groups) is above the pooled rate; and the worst rate over the geometric
    mean of the judged ones, the ``ratio`` of ISO/IEC 19795-10 and of NIST's FRVT (IR 8429).
    """
    wrong = sum(
        ((run >= limit) != same).astype(np.int64)
        for run, limit in zip(similarities, thresholds, strict=True)
    )

    def counted(trials: NDArray[np.bool_]) -> Json:
        errors = int(np.asarray(wrong)[trials].sum()) / len(similarities)
        return mean_rate(errors, int(np.count_nonzero(trials)))

    first, second = (
        np.array([label or "" for label in labels]) for labels in (first_labels, second_labels)
    )
    together = (first != "") & (first == second)
    head: Json = {
        "attribute": attribute,
        "target_fmr": target_fmr,
        "threshold": float(np.mean(thresholds)),
        "runs": len(similarities),
    }
    groups: list[Json] = []
    for name in sorted({*first_labels, *second_labels} - {None}, key=in_order):
        fmr = counted(~same & together & (first == name))
        fnmr = counted(same & together & (first == name))
        fmr["judged"] = fmr_judged(fmr["trials"], target_fmr)
        fnmr["judged"] = fnmr["trials"] >= MIN_GENUINE
        groups.append({**head, "group": name, "fmr": fmr, "fnmr": fnmr})
    summary = head | {"without_common_label": int(np.count_nonzero(~together))}
    for kind, trials in (("fmr", ~same), ("fnmr", same)):
        pooled = summary[f"pooled_{kind}"] = counted(trials & together)
        judged = [(group["group"], group[kind]) for group in groups if group[kind]["judged"]]
        summary[f"worst_{kind}"] = _worst(judged, pooled)
        summary[f"{kind}_ratio"] = _ratio([rate["value"] for _, rate in judged])
    return groups, summary


def fmr_judged(trials: int, target: float) -> bool:
    """Whether a group has 1 / target impostor trials: in fewer, one error exceeds the target."""
    return resolvable(target, trials, expected_errors=1)


def in_order(name: str | None) -> tuple[float, str]:
    """Sort key of labels: ages in the order of years, others by the alphabet."""
    years = re.match(r"\d+", str(name))
    return (float(years.group()) if years else math.inf, str(name))


def _worst(judged: Sequence[tuple[str, Json]], pooled: Json) -> Json | None:
    if len(judged) < 2 or all(rate["errors"] == 0 for _, rate in judged):
        return None
    # Of equal rates the one with more trials is named: it is known best.
    name, rate = max(judged, key=lambda entry: (entry[1]["value"], entry[1]["trials"]))
    low = least_of_highest(rate["errors"], rate["trials"], groups=len(judged))
    return {"group": name, "apart": low > pooled["value"], **rate}


def _ratio(values: Sequence[float]) -> float | None:
    if len(values) < 2 or min(values) == 0:
        return None
    return float(max(values) / math.exp(np.mean(np.log(values))))
