from dataclasses import replace

import pytest

from attacks.outcomes import (
    AttackOutcome,
    Estimate,
    KnowledgeLevel,
    Leaked,
    Property,
    Scheme,
    unproven,
)
from verify.metrics import rate

ROW = AttackOutcome(
    attack="some attack",
    breaks=Property.IRREVERSIBILITY,
    leaked=Leaked.HOLDER_KEYS,
    knowledge=KnowledgeLevel.ALGORITHM,
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
