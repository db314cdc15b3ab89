"""The verdict of a contract: what passes, what fails, and what the data do not show."""

from dataclasses import replace

import pytest

from templates.contract.document import Rate
from templates.contract.verdict import Judgement, upper_bound
from templates.errors import ContractError


def rate(errors: int, trials: int = 400) -> Rate:
    return Rate(errors, trials, 0.0, 1.0)


@pytest.mark.parametrize(
    ("errors", "trials", "bound"),
    # Clopper and Pearson's: scipy.stats.beta.ppf(0.95, errors + 1, trials - errors).
    [(0, 100, 0.029513), (5, 100, 0.102253), (15, 300, 0.075949), (400, 5000, 0.086594), (3, 3, 1)],
)
def test_the_upper_bound_is_exact(errors: int, trials: int, bound: float) -> None:
    assert upper_bound(errors, trials) == pytest.approx(bound, abs=1e-6)


@pytest.mark.parametrize(
    ("judgement", "status", "close"),
    [
        (Judgement(rate(20), 0.05), "PASS", True),
        (Judgement(rate(9), 0.05), "PASS", False),
        (Judgement(rate(21), 0.05), "FAIL", True),
        (Judgement(rate(5, 100), 0.05, bound=0.1), "NOT SHOWN", True),
        (Judgement(rate(15, 300), 0.05, bound=0.1), "PASS", True),
        (Judgement(rate(0, 300), 0.05, bound=0.1, shortfall="few faces"), "NOT SHOWN", True),
        (Judgement(rate(0, 0), 0.05), "NOT SHOWN", True),
    ],
)
def test_a_rate_passes_up_to_its_limit_where_its_bound_is_within(
    judgement: Judgement, status: str, close: bool
) -> None:
    assert (judgement.status, judgement.close) == (status, close)
    assert Judgement.from_json(judgement.to_json()) == judgement


def test_derived_values_are_not_believed() -> None:
    bounded = Judgement(rate(5, 100), 0.05, bound=0.1)
    for broken in ({"upper": 0.05}, {"upper": None}, {"status": "PASS"}, {"value": 0.0}):
        with pytest.raises(ContractError):
            Judgement.from_json({**bounded.to_json(), **broken})
    assert replace(bounded, bound=None).upper is None
