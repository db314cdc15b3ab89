import pytest

from tests.verify.evaluation.made_trials import pool
from verify.evaluation.plan import EvaluationError, EvaluationPlan, units_of


def test_the_paper_s_table_is_five_seeds_of_every_cell() -> None:
    plan = EvaluationPlan(("raw", "random", "adversarial", "hybrid"), dims=(2, 4), seed=10)
    units = units_of(plan, [pool()], n=24)
    lifted = [unit for unit in units if not unit.raw]
    assert len(lifted) == 3 * 2 * 5
    assert {unit.seed for unit in lifted} == {10, 11, 12, 13, 14}
    assert {unit.source for unit in lifted if unit.strategy == "random"} == {None}
    assert [unit.strategy for unit in units if unit.raw] == ["raw"]
    # Long units come first.
    dims = [unit.m for unit in lifted]
    assert dims == sorted(dims, reverse=True)


@pytest.mark.parametrize(
    ("strategies", "sources", "message"),
    [
        (("adversarial",), [], "adversarial lifting needs decoys: .*decoys build"),
        (("hybrid+",), [pool()], "needs a pool with gender and race labels"),
        (("sub-hybrid",), [], "needs a pool"),
    ],
)
def test_a_strategy_without_its_decoys_is_refused(
    strategies: tuple[str, ...], sources: list, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        units_of(EvaluationPlan(strategies), sources, n=24)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strategies": ("lifted",)}, "unknown strategy lifted: choose of raw"),
        ({"strategies": ()}, "unknown strategy"),
        ({"targets": (2.0,)}, "between 0 and 1"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        EvaluationPlan(**{"strategies": ("raw",), **changes})


@pytest.mark.parametrize(
    ("strategy", "dims", "message"),
    [
        ("hybrid", (1,), "from 2 to 23, not 1"),
        ("adversarial", (0,), "from 1 to 23, not 0"),
        ("random", (24, 2), "not 24"),
        ("random", (), "not none"),
    ],
)
def test_dimensions_must_fit(strategy: str, dims: tuple[int, ...], message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        units_of(EvaluationPlan((strategy,), dims=dims), [pool()], n=24)
