"""Rates by group against counts by hand."""

import itertools
import json
import math

import numpy as np
import pytest
from scipy.stats import binomtest, gmean

from verify.evaluation.groups import MIN_GENUINE, MeanRate, by_group


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
    found = report(*TWO_GROUPS)
    counts = {
        group.name: (group.fmr.errors, group.fmr.trials, group.fnmr.errors, group.fnmr.trials)
        for group in found.groups
    }
    assert counts == {"Female": (15, 300, 10, 200), "Male": (3, 1200, 4, 400)}
    assert (found.cross_fmr.errors, found.cross_fmr.trials) == (3, 1003)
    assert (found.mixed, found.unlabelled_genuine, found.unlabelled_impostor) == (3, 6, 8)
    assert (found.overall_fmr.errors, found.overall_fmr.trials) == (22, 2511)
    assert (found.overall_fnmr.errors, found.overall_fnmr.trials) == (15, 609)
    assert (found.pooled_fmr.errors, found.pooled_fmr.trials) == (18, 1500)
    assert (found.pooled_fnmr.errors, found.pooled_fnmr.trials) == (14, 600)


def test_the_worst_group_is_named_with_its_interval():
    found = report(*TWO_GROUPS)
    assert found.worst_fmr.group == found.worst_fnmr.group == "Female"
    wilson = binomtest(15, 300).proportion_ci(0.95, method="wilson")
    assert found.worst_fmr.rate.ci_low == pytest.approx(wilson.low)
    assert found.worst_fmr.rate.ci_high == pytest.approx(wilson.high)
    assert found.worst_fmr.rate.value == 0.05
    assert found.fmr_ratio == pytest.approx(0.05 / gmean([15 / 300, 3 / 1200]))
    assert found.fnmr_ratio == pytest.approx(0.05 / gmean([10 / 200, 4 / 400]))


@pytest.mark.parametrize(("errors", "apart"), [(7, False), (8, False), (9, True), (14, True)])
def test_a_worst_group_is_apart_where_its_widened_interval_is_above_all(errors, apart):
    found = report(
        trials(True, "a", "a", 500 - errors, errors),
        trials(True, "b", "b", 995, 5),
        trials(True, "c", "c", 995, 5),
    )
    pooled = (errors + 10) / 2500
    low = binomtest(errors, 500).proportion_ci(1 - 0.05 / 3, method="wilson").low
    assert (low > pooled) == apart
    assert found.worst_fnmr.group == "a"
    assert found.worst_fnmr.apart == apart


def test_the_interval_is_widened_for_the_number_of_groups():
    """Apart at 95 %, but not as the highest of eight."""
    others = [trials(True, name, name, 990, 10) for name in "bcdefgh"]
    found = report(trials(True, "a", "a", 980, 20), *others)
    pooled = found.pooled_fnmr.value
    assert binomtest(20, 1000).proportion_ci(0.95, method="wilson").low > pooled
    assert found.worst_fnmr.group == "a"
    assert not found.worst_fnmr.apart


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
    found = report(*kinds, target=target)
    judged = {group.name: (group.fmr_judged, group.fnmr_judged) for group in found.groups}
    assert judged == {"few": (False, False), "just": (True, True), "many": (True, True)}
    assert found.worst_fmr.group == found.worst_fnmr.group == "just"
    assert found.fmr_ratio == pytest.approx(math.sqrt(2))
    # A single judged group is the worst of nothing.
    alone = report(*kinds[:2], *kinds[3:5], target=target)
    assert (alone.worst_fmr, alone.worst_fnmr, alone.fmr_ratio, alone.fnmr_ratio) == (None,) * 4


def test_a_group_without_an_error_leaves_the_ratio_undefined():
    found = report(
        trials(False, "a", "a", 200, 0),
        trials(False, "b", "b", 199, 1),
        trials(True, "a", "a", 200, 0),
        trials(True, "b", "b", 200, 0),
    )
    assert found.fmr_ratio is None
    assert found.worst_fmr.group == "b"
    assert found.fnmr_ratio is None
    assert found.worst_fnmr is None


def test_of_equal_rates_the_one_known_best_is_named():
    found = report(
        trials(True, "a", "a", 198, 2),
        trials(True, "b", "b", 396, 4),
        trials(True, "c", "c", 200, 0),
    )
    assert found.worst_fnmr.group == "b"


def test_errors_are_means_over_runs_and_trials_are_of_one():
    rng = np.random.default_rng(0)
    labels = rng.choice(["x", "y"], (2, 3000)).tolist()
    same = rng.random(3000) < 0.5
    runs = [rng.random(3000) for _ in range(5)]
    limits = [0.1, 0.2, 0.3, 0.4, 0.55]
    found = by_group(runs, same, *labels, attribute="race", thresholds=limits, target_fmr=0.01)
    assert found.runs == 5
    assert found.threshold == pytest.approx(0.31)
    for group in found.groups:
        inside = [a == b == group.name for a, b in zip(*labels, strict=True)]
        genuine, impostor = np.array(inside) & same, np.array(inside) & ~same
        misses = [np.sum(run[genuine] < t) for run, t in zip(runs, limits, strict=True)]
        matches = [np.sum(run[impostor] >= t) for run, t in zip(runs, limits, strict=True)]
        assert group.fnmr.errors == pytest.approx(np.mean(misses))
        assert group.fmr.errors == pytest.approx(np.mean(matches))
        assert group.fnmr.trials == genuine.sum()
        # The Wilson interval is between those of the whole counts on either side.
        below, above = (
            binomtest(whole(group.fnmr.errors), group.fnmr.trials).proportion_ci(0.95, "wilson")
            for whole in (math.floor, math.ceil)
        )
        assert below.low <= group.fnmr.ci_low <= above.low
        assert below.high <= group.fnmr.ci_high <= above.high


def test_a_pair_at_the_threshold_matches():
    found = by_group(
        [np.array([0.5, 0.5])],
        np.array([True, False]),
        ["a", "a"],
        ["a", "a"],
        attribute="gender",
        thresholds=[0.5],
        target_fmr=0.5,
    )
    assert (found.groups[0].fnmr.errors, found.groups[0].fmr.errors) == (0, 1)


def test_ages_stand_in_the_order_of_years():
    ages = ["more than 70", "3-9", "20-29", "10-19", "0-2"]
    found = report(*(trials(True, age, age, 1, 0) for age in ages), attribute="age")
    assert [group.name for group in found.groups] == [
        "0-2", "3-9", "10-19", "20-29", "more than 70",
    ]  # fmt: skip


def test_no_label_at_all_leaves_the_overall_rates():
    found = report(trials(True, None, None, 9, 1), trials(False, None, "a", 5, 0))
    assert [group.name for group in found.groups] == ["a"]
    assert found.groups[0].fnmr == MeanRate(0, 0, 0.0, 1.0)
    assert found.groups[0].fnmr.value is None
    assert found.overall_fnmr.value == 0.1
    assert (found.unlabelled_genuine, found.unlabelled_impostor) == (10, 5)


def test_rows_and_summary_are_plain():
    found = report(*TWO_GROUPS)
    rows, summary = json.loads(json.dumps([found.json(), found.summary()], allow_nan=False))
    assert [row["group"] for row in rows] == ["Female", "Male"]
    assert {row["attribute"] for row in rows} == {"gender"}
    assert rows[0]["fmr"]["errors"] == 15
    assert rows[0]["fmr"]["judged"] is True
    assert set(rows[0]["fnmr"]) == {"value", "errors", "trials", "ci_low", "ci_high", "judged"}
    assert summary["worst_fmr"]["group"] == "Female"
    assert summary["worst_fmr"]["apart"] is True
    assert summary["cross_fmr"]["trials"] == 1003
    assert summary["mixed"] == 3


@pytest.mark.parametrize(
    "change",
    [
        {"similarities": []},
        {"similarities": [np.zeros(3)]},
        {"thresholds": [0.1, 0.2]},
        {"first_labels": ["a"]},
        {"similarities": [np.array([0.1, np.nan])]},
        {"target_fmr": 0.0},
    ],
)
def test_what_does_not_fit_is_refused(change):
    given = {
        "similarities": [np.zeros(2)],
        "same": np.array([True, False]),
        "first_labels": ["a", "b"],
        "second_labels": ["a", "b"],
        "attribute": "gender",
        "thresholds": [0.5],
        "target_fmr": 0.01,
    }
    by_group(**given)
    with pytest.raises(ValueError, match="groups need"):
        by_group(**(given | change))
