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


def d_sys(value: float, low: float, high: float) -> Estimate:
    return Estimate(value, low, high, 400, "bootstrap")


def only_cell(*outcomes: AttackOutcome, limits: dict[str, float] | None = None) -> Cell:
    (verdict,) = judge(outcomes, limits=limits)
    (cell,) = verdict.cells
    return cell


RECOVERED, SENT = Property.IRREVERSIBILITY, Property.IMPERSONATION
LINKED, TOLD = Property.UNLINKABILITY, Property.CONFIDENTIALITY
KEPT = {"leaked": Leaked.MASTER_KEY}
SEVERAL = {"knowledge": KnowledgeLevel.TEMPLATES}


@pytest.mark.parametrize(
    ("row", "limit", "excess", "status"),
    [
        (outcome(RECOVERED, rate(0, 1000)), "recovery-success", 0.0, Status.PASS),
        (outcome(RECOVERED, rate(15, 300)), "recovery-success", 0.05, Status.PASS),
        (outcome(RECOVERED, rate(6, 100)), "recovery-success", 0.06, Status.FAIL),
        (outcome(RECOVERED, rate(5, 100)), "recovery-success", 0.05, Status.NOT_SHOWN),
        # Accuracy on either side of chance, as a share of what raw embeddings gain.
        (outcome(TOLD, rate(300, 1000), chance=0.5), "attribute-leakage", 0.5, Status.FAIL),
        (outcome(TOLD, rate(700, 1000), chance=0.5), "attribute-leakage", 0.5, Status.FAIL),
        # D_sys above its null, and below it.
        (outcome(LINKED, d_sys(0.95, 0.9, 0.98), chance=0.085, **KEPT),
         "linkability", 0.865, Status.FAIL),
        (outcome(LINKED, d_sys(0.01, 0.0, 0.05), chance=0.085, **KEPT),
         "linkability", 0.0, Status.PASS),
        # A secret rotation leaves next to nothing.
        *((outcome(breaks, rate(hits, 1000), **KEPT, **more), "success-without-key",
           hits / 1000, status)
          for breaks in (RECOVERED, SENT) for more in ({}, SEVERAL)
          for hits, status in ((1, Status.PASS), (30, Status.FAIL))),
        # What no template withstands has no limit.
        (outcome(RECOVERED, rate(100, 100), **SEVERAL), "success-with-key", 1.0, Status.UNLIMITED),
        (outcome(Property.RENEWABILITY, rate(100, 100)), "success-with-key", 1.0, Status.UNLIMITED),
        (outcome(SENT, rate(100, 100)), "success-with-key", 1.0, Status.UNLIMITED),
    ],
)  # fmt: skip
def test_a_row_is_compared_with_its_limit(
    row: AttackOutcome, limit: str, excess: float, status: Status
) -> None:
    cell = only_cell(row)
    assert (cell.limit, cell.status) == (limit, status)
    assert cell.excess == pytest.approx(excess)
    if status is Status.UNLIMITED:
        assert f"leaked {row.leaked}" in headlines(judge([row]))[0]
        assert only_cell(row, limits={limit: 0.5}).status is Status.FAIL


def test_bounds_are_those_of_wilson_and_the_upper_one_is_one_sided() -> None:
    cell = only_cell(outcome(RECOVERED, rate(15, 300)))
    assert (cell.low, cell.high) == (wilson(15, 300)[0], upper_bound(15, 300))
    low, high = wilson(300, 1000)
    cell = only_cell(outcome(TOLD, rate(300, 1000), chance=0.5))
    assert (cell.low, cell.high) == pytest.approx(((0.5 - high) / 0.4, (0.5 - low) / 0.4))


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


def test_a_doubt_is_not_hidden_behind_a_small_success() -> None:
    known = outcome(Property.IRREVERSIBILITY, rate(1, 1000), attack="measured well")
    doubtful = outcome(Property.IRREVERSIBILITY, rate(0, 10), attack="measured on few")
    for order in ((known, doubtful), (doubtful, known)):
        cell = only_cell(*order)
        assert cell.outcome.attack == "measured on few"
        assert cell.status is Status.NOT_SHOWN
    assert not any("no attack" in line for line in headlines(judge([known, doubtful])))


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
