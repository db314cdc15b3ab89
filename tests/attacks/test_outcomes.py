from dataclasses import replace

import pytest

from attacks.outcomes import (
    AttackOutcome,
    Estimate,
    Knowledge,
    Leaked,
    Property,
    Scheme,
    judged_by_controls,
    unproven,
)
from verify.metrics import rate

ROW = AttackOutcome(
    attack="some attack",
    breaks=Property.IRREVERSIBILITY,
    leaked=Leaked.HOLDER_KEYS,
    knowledge=Knowledge.ALGORITHM,
    assumption="Has what it has.",
    scheme=Scheme("adversarial", "generator", 16),
    measured=rate(0, 300),
    chance=0.001,
)


@pytest.mark.parametrize(("hits", "succeeds"), [(0, False), (1, False), (4, True), (300, True)])
def test_a_share_succeeds_where_its_interval_lies_above_chance(hits: int, succeeds: bool) -> None:
    control = replace(ROW, measured=rate(hits, 300))
    assert control.succeeds == succeeds
    assert (unproven(control, "the key stolen") is None) == succeeds


@pytest.mark.parametrize(("low", "succeeds"), [(0.08, False), (0.1, True)])
def test_a_d_sys_succeeds_where_it_lies_above_the_null(low: float, succeeds: bool) -> None:
    """Above its 95th percentile, and not above its mean."""
    control = replace(
        ROW,
        breaks=Property.UNLINKABILITY,
        measured=Estimate(0.2, low, 0.3, 300, "bootstrap"),
        chance=0.07,
        details={"null_95_percent": 0.09},
    )
    assert control.succeeds == succeeds


def test_rows_are_judged_by_the_row_of_their_name_that_has_the_key() -> None:
    opened, closed = rate(300, 300), rate(0, 300)
    rows = [
        replace(ROW, attack=attack, variant=f"the key {key}", measured=measured, unjudged=why)
        for attack, key, measured, why in (
            ("works", "kept", closed, None),
            ("works", "stolen", opened, "a control"),
            # Its own success does not count: one row in twenty or so has it by chance.
            ("fails", "kept", opened, None),
            ("fails", "stolen", closed, "a control"),
            ("few people", "kept", closed, "few people have the photos"),
            ("few people", "stolen", closed, "a control"),
        )
    ]
    assert [row.unjudged for row in judged_by_controls(rows, "key kept", "key stolen")] == [
        None,
        "a control",
        "it proves nothing, for its control, key stolen, does not succeed either",
        "a control",
        "few people have the photos",
        "a control",
    ]


def test_a_control_may_have_to_reach_a_share() -> None:
    half = replace(ROW, measured=rate(150, 300))
    assert unproven(half, "a drawing", least=0.5) is None
    fewer = replace(ROW, measured=rate(149, 300))
    assert unproven(fewer, "a drawing", least=0.5) == (
        "it proves nothing, for its control, a drawing, does not succeed either"
    )
