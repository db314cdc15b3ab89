"""The estimate is the measured slice, scaled to all that one scheme searches."""

import pytest

from attacks.attributes.cost import SearchCost, full_pairs, measure_cost
from attacks.attributes.experiment import run_scheme
from attacks.attributes.faces import Split
from attacks.attributes.plan import AttributePlan, prepare
from attacks.outcomes import Scheme
from tests.attacks.attributes.people import faces


def test_the_estimate_scales_with_the_pairs() -> None:
    cost = SearchCost(n=512, m=16, k=50, threads=2, pairs=2_000_000, seconds=1.0)
    assert cost.per_million == 0.5
    # Victims among all faces; 10,000 own templates among 10,000 faces.
    pairs = 76_744 * 10_954 + 10_000 * 10_000
    document = cost.to_json()
    assert document["full_size_pairs"] == pairs
    assert document["full_size_seconds"] == pytest.approx(0.5 * pairs / 1e6)


@pytest.mark.parametrize("most", [60, 10_000])
def test_the_pairs_are_those_that_one_scheme_searches(most: int) -> None:
    plan = AttributePlan(
        attackers=(), feature_ks=(10,), gallery_most=most, training_most=100, lifts=2
    )
    setup = prepare(
        Split(faces(20, seed=1), faces(120, seed=2), faces(30, seed=3)), plan=plan, seed=1
    )
    done: list[int] = []
    run_scheme(setup, Scheme("random", None, 4), progress=done.append)
    assert sum(done) == (4 + 1) * full_pairs(plan, faces=120, templates=30)


def test_a_slice_is_timed() -> None:
    cost = measure_cost(n=32, m=2)
    assert (cost.pairs, cost.k, cost.threads) == (4096 * 512, 50, 2)
    assert cost.seconds > 0
