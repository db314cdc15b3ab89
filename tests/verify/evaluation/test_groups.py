"""Rates by group against counts by hand."""

import itertools
import json
import math

import numpy as np
import pytest
from scipy.stats import binomtest, gmean

from verify.evaluation.groups import MIN_GENUINE, by_group


def trials(same: bool, first: str | None, second: str | None, right: int, wrong: int):
    """Pairs of one kind at threshold 0.5: similarity, truth, both labels."""
    good, bad = (0.9, 0.1) if same else (0.1, 0.9)
    return [(good, same, first, second)] * right + [(bad, same, first, second)] * wrong


def report(*kinds, target=0.01, attribute="gender"):
    pairs = list(itertools.chain(*kinds))
    scores, same, first, second = (list(column) for column in zip(*pairs, strict=True))
    return by_group(
        [np.array(scores)],
        np.array(same),
        first,
        second,
        attribute=attribute,
        thresholds=[0.5],
        target_fmr=target,
    )


def counts(rate):
    return rate["errors"], rate["trials"]


TWO_GROUPS = (
    trials(True, "Female", "Female", 190, 10),
    trials(True, "Male", "Male", 396, 4),
    trials(True, "Male", "Female", 2, 1),
    trials(True, None, "Female", 6, 0),
    trials(False, "Female", "Female", 285, 15),
    trials(False, "Male", "Male", 1197, 3),
    trials(False, "Female", "Male", 600, 2),
    trials(False, "Male", "Female", 400, 1),
    trials(False, "Male", None, 7, 1),
)


def test_every_trial_is_counted_once():
    groups, summary = report(*TWO_GROUPS)
    found = {group["group"]: (counts(group["fmr"]), counts(group["fnmr"])) for group in groups}
    assert found == {"Female": ((15, 300), (10, 200)), "Male": ((3, 1200), (4, 400))}
    assert counts(summary["pooled_fmr"]) == (18, 1500)
    assert counts(summary["pooled_fnmr"]) == (14, 600)
    assert summary["without_common_label"] == 3 + 6 + 602 + 401 + 8
    json.dumps([groups, summary], allow_nan=False)


def test_the_worst_group_is_named_with_its_interval():
    _, summary = report(*TWO_GROUPS)
    worst = summary["worst_fmr"]
    assert worst["group"] == summary["worst_fnmr"]["group"] == "Female"
    wilson = binomtest(15, 300).proportion_ci(0.95, method="wilson")
    assert (worst["ci_low"], worst["ci_high"]) == pytest.approx((wilson.low, wilson.high))
    assert worst["value"] == 0.05
    assert summary["fmr_ratio"] == pytest.approx(0.05 / gmean([15 / 300, 3 / 1200]))
    assert summary["fnmr_ratio"] == pytest.approx(0.05 / gmean([10 / 200, 4 / 400]))


@pytest.mark.parametrize(
    ("errors", "groups", "apart"),
    [(7, 3, False), (8, 3, False), (9, 3, True), (14, 3, True), (10, 2, True), (7, 6, False)],
)
def test_a_worst_group_is_apart_where_its_widened_interval_is_above_all(errors, groups, apart):
    others = "bcdefghij"[: groups - 1]
    _, summary = report(
        trials(True, "a", "a", 500 - errors, errors),
        *(trials(True, name, name, 995, 5) for name in others),
    )
    pooled = (errors + 5 * len(others)) / (500 + 1000 * len(others))
    low = binomtest(errors, 500).proportion_ci(1 - 0.05 / groups, method="wilson").low
    assert (low > pooled) == apart
    assert summary["worst_fnmr"]["group"] == "a"
    assert summary["worst_fnmr"]["apart"] == apart


@pytest.mark.parametrize("target", [0.01, 0.001, 0.003])
def test_groups_of_few_trials_are_listed_and_not_named(target):
    needed = math.ceil(1 / target)
    kinds = [
        trials(False, "few", "few", needed - 2, 1),
        trials(False, "just", "just", needed - 1, 1),
        trials(False, "many", "many", 2 * needed - 1, 1),
        trials(True, "few", "few", MIN_GENUINE - 3, 2),
        trials(True, "just", "just", MIN_GENUINE - 1, 1),
        trials(True, "many", "many", 2 * MIN_GENUINE - 1, 1),
    ]
    groups, summary = report(*kinds, target=target)
    judged = {g["group"]: (g["fmr"]["judged"], g["fnmr"]["judged"]) for g in groups}
    assert judged == {"few": (False, False), "just": (True, True), "many": (True, True)}
    assert summary["worst_fmr"]["group"] == summary["worst_fnmr"]["group"] == "just"
    assert summary["fmr_ratio"] == pytest.approx(math.sqrt(2))
    # A single judged group is the worst of nothing.
    _, alone = report(*kinds[:2], *kinds[3:5], target=target)
    names = ("worst_fmr", "worst_fnmr", "fmr_ratio", "fnmr_ratio")
    assert [alone[name] for name in names] == [None] * 4


def test_a_group_without_an_error_leaves_the_ratio_undefined():
    _, summary = report(
        trials(False, "a", "a", 200, 0),
        trials(False, "b", "b", 199, 1),
        trials(True, "a", "a", 200, 0),
        trials(True, "b", "b", 200, 0),
    )
    assert summary["fmr_ratio"] is None
    assert summary["worst_fmr"]["group"] == "b"
    assert summary["fnmr_ratio"] is None
    assert summary["worst_fnmr"] is None


def test_errors_are_means_over_runs_and_trials_are_of_one():
    rng = np.random.default_rng(0)
    labels = rng.choice(["x", "y"], (2, 3000)).tolist()
    same = rng.random(3000) < 0.5
    runs = [rng.random(3000) for _ in range(5)]
    limits = [0.1, 0.2, 0.3, 0.4, 0.55]
    groups, summary = by_group(
        runs, same, *labels, attribute="race", thresholds=limits, target_fmr=0.01
    )
    assert summary["runs"] == 5
    assert summary["threshold"] == pytest.approx(0.31)
    for group in groups:
        inside = [a == b == group["group"] for a, b in zip(*labels, strict=True)]
        genuine, impostor = np.array(inside) & same, np.array(inside) & ~same
        misses = [np.sum(run[genuine] < t) for run, t in zip(runs, limits, strict=True)]
        matches = [np.sum(run[impostor] >= t) for run, t in zip(runs, limits, strict=True)]
        fnmr = group["fnmr"]
        assert fnmr["errors"] == pytest.approx(np.mean(misses))
        assert group["fmr"]["errors"] == pytest.approx(np.mean(matches))
        assert fnmr["trials"] == genuine.sum()
        # The Wilson interval is between those of the whole counts on either side.
        below, above = (
            binomtest(whole(fnmr["errors"]), fnmr["trials"]).proportion_ci(0.95, "wilson")
            for whole in (math.floor, math.ceil)
        )
        assert below.low <= fnmr["ci_low"] <= above.low
        assert below.high <= fnmr["ci_high"] <= above.high


def test_a_pair_at_the_threshold_matches():
    (group,), _ = by_group(
        [np.array([0.5, 0.5])],
        np.array([True, False]),
        ["a", "a"],
        ["a", "a"],
        attribute="gender",
        thresholds=[0.5],
        target_fmr=0.5,
    )
    assert (group["fnmr"]["errors"], group["fmr"]["errors"]) == (0, 1)


def test_ages_stand_in_the_order_of_years():
    ages = ["more than 70", "3-9", "20-29", "10-19", "0-2"]
    groups, _ = report(*(trials(True, age, age, 1, 0) for age in ages), attribute="age")
    expected = ["0-2", "3-9", "10-19", "20-29", "more than 70"]
    assert [group["group"] for group in groups] == expected
