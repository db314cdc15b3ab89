import math

import pytest

from attacks.outcomes import AttackOutcome, Estimate, Knowledge, Measured, Property, Scheme
from attacks.verdict import LIMITS, Status, headlines, judge
from verify.metrics import rate, wilson

SCHEME = Scheme("adversarial", "generator", 16)


def outcome(
    breaks: Property,
    measured: Measured,
    *,
    knowledge: Knowledge = Knowledge.ALGORITHM,
    chance: float = 0.001,
    attack: str = "some attack",
    judged: bool = True,
    scheme: Scheme = SCHEME,
) -> AttackOutcome:
    return AttackOutcome(
        attack=attack,
        breaks=breaks,
        knowledge=knowledge,
        assumption="Has what it has.",
        scheme=scheme,
        measured=measured,
        chance=chance,
        judged=judged,
    )


def only_cell(*outcomes: AttackOutcome, limits: dict[str, float] | None = None):
    (verdict,) = judge(outcomes, limits=limits)
    (cell,) = verdict.cells
    return cell


@pytest.mark.parametrize(
    ("hits", "trials", "status"),
    [(0, 1000, Status.PASS), (12, 100, Status.FAIL), (9, 100, Status.UNRESOLVED)],
)
def test_a_recovery_is_compared_with_its_limit(hits: int, trials: int, status: Status) -> None:
    cell = only_cell(outcome(Property.IRREVERSIBILITY, rate(hits, trials)))
    assert cell.limit == "recovery-success"
    assert cell.most == 0.1
    assert cell.excess == hits / trials
    assert (cell.low, cell.high) == wilson(hits, trials)
    assert cell.status is status


def test_the_strongest_attack_fills_the_cell_and_unjudged_ones_do_not() -> None:
    weak = outcome(Property.IRREVERSIBILITY, rate(1, 100), attack="weak")
    strong = outcome(Property.IRREVERSIBILITY, rate(5, 100), attack="strong")
    oracle = outcome(Property.IRREVERSIBILITY, rate(99, 100), attack="oracle", judged=False)
    assert only_cell(weak, strong, oracle).outcome.attack == "strong"
    assert only_cell(oracle, strong, weak).outcome.attack == "strong"


def test_the_foot_point_has_a_limit_and_a_cell_of_its_own() -> None:
    foot = outcome(
        Property.IRREVERSIBILITY, rate(20, 100), attack="foot-point", knowledge=Knowledge.TEMPLATE
    )
    other = outcome(Property.IRREVERSIBILITY, rate(50, 100), knowledge=Knowledge.TEMPLATE)
    (verdict,) = judge([foot, other], limits={"foot-point-success": 0.3})
    statuses = {cell.limit: cell.status for cell in verdict.cells}
    assert statuses == {"foot-point-success": Status.PASS, "recovery-success": Status.FAIL}
    assert not verdict.passed


@pytest.mark.parametrize("correct", [300, 700])
def test_accuracy_fails_on_either_side_of_chance(correct: int) -> None:
    cell = only_cell(outcome(Property.CONFIDENTIALITY, rate(correct, 1000), chance=0.5))
    low, high = wilson(correct, 1000)
    assert cell.excess == pytest.approx(0.2)
    assert cell.low == pytest.approx(min(abs(low - 0.5), abs(high - 0.5)))
    assert cell.high == pytest.approx(max(abs(low - 0.5), abs(high - 0.5)))
    assert cell.status is Status.FAIL


def test_an_interval_that_holds_chance_starts_at_nothing() -> None:
    cell = only_cell(outcome(Property.CONFIDENTIALITY, rate(505, 1000), chance=0.5))
    assert cell.low == 0.0
    assert cell.status is Status.PASS


def test_linkability_is_compared_above_its_null() -> None:
    linked = Estimate(0.95, 0.9, 0.98, 400, "bootstrap")
    cell = only_cell(outcome(Property.UNLINKABILITY, linked, chance=0.085))
    assert cell.excess == pytest.approx(0.865)
    assert cell.status is Status.FAIL


def test_a_d_sys_below_its_null_tells_nothing() -> None:
    below = Estimate(0.01, 0.0, 0.05, 400, "bootstrap")
    cell = only_cell(outcome(Property.UNLINKABILITY, below, chance=0.2))
    assert (cell.excess, cell.low, cell.high) == (0.0, 0.0, 0.0)
    assert cell.status is Status.PASS


def test_a_doubt_is_not_hidden_behind_a_small_success() -> None:
    known = outcome(Property.IRREVERSIBILITY, rate(1, 1000), attack="measured well")
    doubtful = outcome(Property.IRREVERSIBILITY, rate(0, 10), attack="measured on few")
    for order in ((known, doubtful), (doubtful, known)):
        cell = only_cell(*order)
        assert cell.outcome.attack == "measured on few"
        assert cell.status is Status.UNRESOLVED
    assert not any("no attack" in line for line in headlines(judge([known, doubtful])))


def test_who_has_the_key_is_unlimited_unless_the_operator_limits_it() -> None:
    replay = outcome(Property.IMPERSONATION, rate(100, 100), knowledge=Knowledge.KEY)
    assert only_cell(replay).status is Status.UNLIMITED
    assert only_cell(replay, limits={"success-with-key": 0.5}).status is Status.FAIL


def test_who_has_several_templates_has_a_limit_of_its_own() -> None:
    meets = outcome(
        Property.IRREVERSIBILITY, rate(90, 100), knowledge=Knowledge.TEMPLATES, attack="meets"
    )
    assert only_cell(meets).limit == "success-with-templates"
    assert only_cell(meets).status is Status.FAIL
    assert only_cell(meets, limits={"success-with-templates": 1.0}).status is Status.UNLIMITED
    linked = Estimate(0.3, 0.2, 0.4, 400, "bootstrap")
    cell = only_cell(outcome(Property.UNLINKABILITY, linked, knowledge=Knowledge.TEMPLATES))
    assert cell.limit == "linkability"


def test_schemes_are_judged_apart() -> None:
    other = Scheme("random", None, 2)
    verdicts = judge(
        [
            outcome(Property.IRREVERSIBILITY, rate(0, 1000)),
            outcome(Property.IRREVERSIBILITY, rate(990, 1000), scheme=other),
        ]
    )
    assert [(each.scheme, each.passed) for each in verdicts] == [(SCHEME, True), (other, False)]


def test_what_fails_is_said_first() -> None:
    verdicts = judge(
        [
            outcome(Property.IMPERSONATION, rate(100, 100), knowledge=Knowledge.KEY, attack="key"),
            outcome(Property.IRREVERSIBILITY, rate(50, 100), attack="recovers"),
        ]
    )
    lines = headlines(verdicts)
    assert "irreversibility fails: recovers" in lines[0]
    assert "limit 0.1" in lines[0]
    assert "impersonation is broken, and no limit is set on it" in lines[1]
    assert not any("no attack" in line for line in lines)
    assert headlines(judge([outcome(Property.IRREVERSIBILITY, rate(0, 1000))])) == [
        "adversarial, m = 16, generated decoys: no attack that was made exceeds its limit."
    ]


def test_every_limit_is_a_share_and_named_once() -> None:
    names = [limit.name for limit in LIMITS]
    assert len(set(names)) == len(names)
    assert all(0 <= limit.default <= 1 and math.isfinite(limit.default) for limit in LIMITS)
