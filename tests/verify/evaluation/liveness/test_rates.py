"""Error rates of presentation attack detection against counting one by one."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.verify.evaluation.liveness.sets import scored_set
from verify.datasets import DatasetError
from verify.evaluation.liveness.rates import calibrate_liveness, threshold_at_bpcer
from verify.evaluation.liveness.scores import VerifiedSet, share
from verify.metrics import wilson

STATED = [
    *((None, "a", score) for score in (0.9, 0.8, 0.7, 0.2)),
    (None, "b", None),
    ("print", "a", 0.1),
    ("print", "b", 0.7),
    ("print", "b", None),
    ("mask", "b", 0.95),
    ("mask", "b", 0.3),
]


def test_rates_of_a_stated_set():
    scored = scored_set(STATED)
    rates = {
        "bpcer": scored.bpcer(0.7),
        # At the threshold is live, of a live face as of an attack.
        "print": scored.apcer("print", 0.7),
        "mask": scored.apcer("mask", 0.7),
        "bpnrr": scored.non_response(None),
        "apnrr of print": scored.non_response("print"),
        "apnrr of mask": scored.non_response("mask"),
    }
    assert {name: (rate.errors, rate.trials) for name, rate in rates.items()} == {
        "bpcer": (1, 4),
        "print": (1, 2),
        "mask": (1, 2),
        "bpnrr": (1, 5),
        "apnrr of print": (1, 3),
        "apnrr of mask": (0, 2),
    }


@given(
    st.lists(st.integers(-20, 20), min_size=30, max_size=80),
    st.sampled_from([0.1, 0.2, 0.25, 0.5]),
)
def test_a_threshold_is_the_highest_that_keeps_the_bpcer(values, target):
    live = np.array(values) / 4
    threshold = threshold_at_bpcer(live, target)
    assert sum(score < threshold for score in live) <= target * len(live)
    # The next threshold would reject the lowest score that passes, and that is too many.
    lowest = min(score for score in live if score >= threshold)
    assert sum(score <= lowest for score in live) > target * len(live)


def test_too_few_live_photos_for_a_rate():
    with pytest.raises(DatasetError, match=r"59 live photos cannot resolve BPCER 0\.05.*60"):
        threshold_at_bpcer(np.arange(59.0), 0.05)
    assert threshold_at_bpcer(np.arange(60.0), 0.05) == pytest.approx(2.5)


def test_an_interval_without_people_is_wilsons():
    errors = np.array([True] * 3 + [False] * 17)
    for subjects in ([None] * 20, ["a"] * 20, [None, *["b"] * 19]):
        counted = share(errors, subjects)
        assert (counted.ci_low, counted.ci_high) == pytest.approx(wilson(3, 20))
        assert counted.interval == "wilson"


def test_an_interval_of_people_is_wider_where_one_person_makes_the_errors():
    subjects = [f"person {row // 20}" for row in range(200)]
    of_one = np.array([row // 20 == 3 for row in range(200)])
    spread = np.array([row % 10 == 0 for row in range(200)])
    low, high = wilson(20, 200)
    concentrated = share(of_one, subjects)
    assert concentrated.interval == "subject-bootstrap"
    assert concentrated.ci_low < low
    assert concentrated.ci_high > high + 0.05
    everybody = share(spread, subjects)
    assert (everybody.ci_low, everybody.ci_high) == pytest.approx((low, high))


def test_a_calibration_counts_what_it_states():
    generator = np.random.default_rng(5)
    live = generator.normal(1, 1, 80)
    attacks = {"print": generator.normal(-1, 1, 40), "mask": generator.normal(0.5, 1, 30)}
    scored = scored_set(
        [(None, None, float(score)) for score in live]
        + [(name, None, float(one)) for name, scores in attacks.items() for one in scores]
        + [("cut-out", None, None), ("mask", None, None)]
    )
    calibration = calibrate_liveness(scored, ("ab" * 32,), target=0.05)
    rejected = sum(score < calibration.threshold for score in live)
    assert rejected == 4
    assert (calibration.bpcer.errors, calibration.bpcer.trials) == (rejected, 80)
    assert {name: (rate.errors, rate.trials) for name, rate in calibration.apcer.items()} == {
        name: (sum(score >= calibration.threshold for score in scores), len(scores))
        for name, scores in attacks.items()
    }
    assert calibration.worst_species == "mask"
    assert calibration.calibrated_on["attacks_without_face"] == {
        "cut-out": 1,
        "mask": 1,
        "print": 0,
    }


def test_the_whole_verification_counts_who_passes_both():
    scored = scored_set(STATED)
    verified = VerifiedSet(
        scored=scored,
        matched=np.array([True, True, False, True, False, True, True, False, True, False]),
        tried=np.array([False, True, True, True, True, True, True, True, False, True]),
        level="fmr-1e-3",
        target_fmr=1e-3,
        enrolled_photos=1,
        enrolled=2,
        left_out=(),
    )
    # Live, tried: 0.8 matched, 0.7 not, 0.2 matched, and one without a face.
    assert (verified.false_rejections(None).errors, verified.false_rejections(None).trials) == (
        2,
        4,
    )
    assert verified.false_rejections(0.5).errors == 3
    # Print: 0.1 and 0.7 match; the one without a face was shown and is no match.
    assert (verified.iapmr("print", None).errors, verified.iapmr("print", None).trials) == (2, 3)
    assert verified.iapmr("print", 0.5).errors == 1
    assert (verified.iapmr("mask", None).errors, verified.iapmr("mask", None).trials) == (0, 1)
