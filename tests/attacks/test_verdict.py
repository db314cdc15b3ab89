from dataclasses import replace

import pytest

from attacks.outcomes import (
    COMPARED,
    CONTROL,
    AttackOutcome,
    Estimate,
    KnowledgeLevel,
    Leaked,
    Measured,
    Property,
    Scheme,
)
from attacks.verdict import Cell, Status, headlines, judge
from templates.contract.verdict import upper_bound
from verify.metrics import rate, wilson

SCHEME = Scheme("adversarial", "generator", 16)


def outcome(
    breaks: Property,
    measured: Measured,
    *,
    leaked: Leaked = Leaked.HOLDER_KEYS,
    knowledge: KnowledgeLevel = KnowledgeLevel.ALGORITHM,
    chance: float = 0.001,
    attack: str = "some attack",
    unjudged: str | None = None,
    scheme: Scheme = SCHEME,
    gain: float = 0.4,
) -> AttackOutcome:
    return AttackOutcome(
        attack=attack,
        breaks=breaks,
        leaked=leaked,
        knowledge=knowledge,
        assumption="Has what it has.",
        scheme=scheme,
        measured=measured,
        chance=chance,
        unjudged=unjudged,
        details={"raw_gain": gain} if breaks is Property.CONFIDENTIALITY else {},
    )


def only_cell(*outcomes: AttackOutcome, limits: dict[str, float] | None = None) -> Cell:
    (verdict,) = judge(outcomes, limits=limits)
    (cell,) = verdict.cells
    return cell


@pytest.mark.parametrize(
    ("hits", "trials", "status"),
    [
        (0, 1000, Status.PASS),
        (15, 300, Status.PASS),
        (6, 100, Status.FAIL),
        (5, 100, Status.NOT_SHOWN),
    ],
)
def test_a_recovery_is_compared_with_its_limit(hits: int, trials: int, status: Status) -> None:
    cell = only_cell(outcome(Property.IRREVERSIBILITY, rate(hits, trials)))
    assert cell.limit == "recovery-success"
    assert cell.most == 0.05
    assert cell.excess == hits / trials
    assert (cell.low, cell.high) == (wilson(hits, trials)[0], upper_bound(hits, trials))
    assert cell.status is status


def test_what_an_attacker_had_too_little_for_is_not_shown() -> None:
    few = outcome(Property.IRREVERSIBILITY, rate(0, 1000))
    few = replace(few, details={"too_few": "it takes 100 victims"})
    (verdict,) = judge([few])
    assert (verdict.cells[0].status, verdict.passed) == (Status.NOT_SHOWN, None)
    assert "is not shown to hold" in headlines([verdict])[0]


def test_the_strongest_attack_fills_the_cell_and_unjudged_ones_do_not() -> None:
    weak = outcome(Property.IRREVERSIBILITY, rate(1, 100), attack="weak")
    strong = outcome(Property.IRREVERSIBILITY, rate(3, 100), attack="strong")
    oracle = outcome(
        Property.IRREVERSIBILITY, rate(99, 100), attack="oracle", unjudged="nobody has it"
    )
    assert only_cell(weak, strong, oracle).outcome.attack == "strong"
    assert only_cell(oracle, strong, weak).outcome.attack == "strong"


def test_the_foot_point_has_a_limit_and_a_cell_of_its_own() -> None:
    foot = outcome(
        Property.IRREVERSIBILITY,
        rate(20, 100),
        attack="foot-point",
        knowledge=KnowledgeLevel.TEMPLATE,
    )
    other = outcome(Property.IRREVERSIBILITY, rate(50, 100), knowledge=KnowledgeLevel.TEMPLATE)
    (verdict,) = judge([foot, other], limits={"foot-point-success": 0.3})
    statuses = {cell.limit: cell.status for cell in verdict.cells}
    assert statuses == {"foot-point-success": Status.PASS, "recovery-success": Status.FAIL}
    assert not verdict.passed


@pytest.mark.parametrize("correct", [300, 700])
def test_accuracy_fails_on_either_side_of_chance(correct: int) -> None:
    cell = only_cell(outcome(Property.CONFIDENTIALITY, rate(correct, 1000), chance=0.5))
    low, high = wilson(correct, 1000)
    assert cell.excess == pytest.approx(0.2 / 0.4)  # of what raw embeddings gain
    assert cell.low == pytest.approx(min(abs(low - 0.5), abs(high - 0.5)) / 0.4)
    assert cell.high == pytest.approx(max(abs(low - 0.5), abs(high - 0.5)) / 0.4)
    assert cell.status is Status.FAIL


@pytest.mark.parametrize(
    ("measured", "excess", "status"),
    [
        (Estimate(0.95, 0.9, 0.98, 400, "bootstrap"), 0.865, Status.FAIL),
        (Estimate(0.01, 0.0, 0.05, 400, "bootstrap"), 0.0, Status.PASS),  # below its null
    ],
)
def test_linkability_is_compared_above_its_null(
    measured: Estimate, excess: float, status: Status
) -> None:
    stolen = Leaked.MASTER_KEY
    cell = only_cell(outcome(Property.UNLINKABILITY, measured, leaked=stolen, chance=0.085))
    assert (cell.limit, cell.status) == ("linkability", status)
    assert cell.excess == pytest.approx(excess)


def test_a_doubt_is_not_hidden_behind_a_small_success() -> None:
    known = outcome(Property.IRREVERSIBILITY, rate(1, 1000), attack="measured well")
    doubtful = outcome(Property.IRREVERSIBILITY, rate(0, 10), attack="measured on few")
    for order in ((known, doubtful), (doubtful, known)):
        cell = only_cell(*order)
        assert cell.outcome.attack == "measured on few"
        assert cell.status is Status.NOT_SHOWN
    assert not any("no attack" in line for line in headlines(judge([known, doubtful])))


@pytest.mark.parametrize(
    ("breaks", "leaked", "knowledge"),
    [
        (Property.IRREVERSIBILITY, Leaked.HOLDER_KEYS, KnowledgeLevel.TEMPLATES),
        (Property.RENEWABILITY, Leaked.HOLDER_KEYS, KnowledgeLevel.ALGORITHM),
        (Property.IMPERSONATION, Leaked.HOLDER_KEYS, KnowledgeLevel.ALGORITHM),
    ],
)
def test_what_no_template_withstands_is_without_a_limit_and_says_why(
    breaks: Property, leaked: Leaked, knowledge: KnowledgeLevel
) -> None:
    broken = outcome(breaks, rate(100, 100), leaked=leaked, knowledge=knowledge)
    cell = only_cell(broken)
    assert (cell.limit, cell.status) == ("success-with-key", Status.UNLIMITED)
    assert cell.reason
    line, _no_limit_exceeded = headlines(judge([broken]))
    assert f"leaked {leaked}" in line
    assert line.endswith(f"By design: {cell.reason}.")
    limited = only_cell(broken, limits={"success-with-key": 0.5})
    assert (limited.status, limited.reason) == (Status.FAIL, None)


@pytest.mark.parametrize("knowledge", [KnowledgeLevel.ALGORITHM, KnowledgeLevel.TEMPLATES])
@pytest.mark.parametrize("breaks", [Property.IRREVERSIBILITY, Property.IMPERSONATION])
def test_a_secret_rotation_leaves_next_to_nothing(
    breaks: Property, knowledge: KnowledgeLevel
) -> None:
    def cell(hits: int) -> Cell:
        stolen = Leaked.MASTER_KEY
        return only_cell(outcome(breaks, rate(hits, 1000), leaked=stolen, knowledge=knowledge))

    assert (cell(1).limit, cell(1).status) == ("success-without-key", Status.PASS)
    assert cell(30).status is Status.FAIL


def test_what_leaked_parts_the_cells() -> None:
    (verdict,) = judge(
        [
            outcome(Property.IRREVERSIBILITY, rate(5, 1000)),
            outcome(Property.IRREVERSIBILITY, rate(0, 1000), leaked=Leaked.MASTER_KEY),
        ]
    )
    assert [(cell.outcome.leaked, cell.excess) for cell in verdict.cells] == [
        (Leaked.MASTER_KEY, 0.0),
        (Leaked.HOLDER_KEYS, 0.005),
    ]


def test_a_scheme_of_which_nothing_is_judged_neither_passes_nor_fails() -> None:
    row = outcome(Property.IRREVERSIBILITY, rate(0, 1000), unjudged="its control fails")
    (verdict,) = judge([row])
    assert (verdict.passed, verdict.cells, verdict.unjudged) == (None, (), (row,))
    first, *rest = headlines([verdict])
    assert first.endswith("no attack was judged, so it neither passed nor failed.")
    assert ["its control fails" in line for line in rest] == [True]
    # What is there to compare with, and a control of another scheme, are no scheme's verdict.
    for reason in (COMPARED, CONTROL):
        assert judge([outcome(Property.IRREVERSIBILITY, rate(0, 9), unjudged=reason)]) == []


def test_what_fails_is_said_first() -> None:
    verdicts = judge(
        [
            outcome(Property.IMPERSONATION, rate(100, 100), attack="key"),
            outcome(Property.IRREVERSIBILITY, rate(50, 100), attack="recovers"),
        ]
    )
    lines = headlines(verdicts)
    assert "irreversibility fails: recovers" in lines[0]
    assert "limit 0.05" in lines[0]
    assert "impersonation is broken, and no limit is set on it" in lines[1]
    assert not any("no attack" in line for line in lines)
    assert headlines(judge([outcome(Property.IRREVERSIBILITY, rate(0, 1000))])) == [
        "adversarial, m = 16, generated decoys: no attack that was made exceeds its limit."
    ]


def test_what_is_not_judged_is_named_with_its_reason_right_after_what_fails() -> None:
    rows = [
        outcome(Property.IRREVERSIBILITY, rate(50, 100), attack="recovers"),
        outcome(Property.IMPERSONATION, rate(100, 100), attack="key"),
        outcome(Property.IRREVERSIBILITY, rate(60, 100), attack="estimate", unjudged="drawn"),
        *(
            outcome(Property.IRREVERSIBILITY, rate(9, 100), attack="few decoys", unjudged=CONTROL)
            for _ in range(2)
        ),
        outcome(Property.IRREVERSIBILITY, rate(1, 100), attack="oracle", unjudged="nobody has it"),
    ]
    (verdict,) = judge(rows)
    fails, drawn, nobody, controls, broken = headlines([verdict])
    assert "irreversibility fails: recovers" in fails
    assert drawn.endswith("generated decoys: not judged (drawn): estimate: 0.6 [0.502, 0.691].")
    assert "not judged (nobody has it): oracle: 0.01" in nobody
    assert controls.endswith("not judged (a control): few decoys.")
    assert "is broken" in broken
    assert [row["reason"] for row in verdict.to_json()["not_judged"]] == [
        "drawn", CONTROL, CONTROL, "nobody has it",
    ]  # fmt: skip
