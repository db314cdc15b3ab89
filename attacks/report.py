"""The report of an audit, as one document; docs/formats.md describes it field by field."""

from collections.abc import Mapping, Sequence
from typing import Any

from attacks.outcomes import AttackOutcome
from attacks.verdict import LIMITS, headlines, judge

RESULTS = {
    True: "PASSED",
    False: "FAILED: a limit is exceeded.",
    None: "NOT SHOWN: no limit is exceeded, and not every one is shown to hold.",
}
"""The first line of a report, by ``passed``."""
FORMAT = "veilface audit"
VERSION = 1
Document = dict[str, Any]


def document(
    kind: str,
    *,
    outcomes: Sequence[AttackOutcome],
    rows: Sequence[Mapping[str, Any]] = (),
    limits: Mapping[str, float],
    comparisons: Sequence[str] = (),
    model: Mapping[str, Any],
    settings: Mapping[str, Any],
    **more: Any,
) -> Document:
    """Put a report together.

    Parameters
    ----------
    kind
        ``fairface`` or ``templates``.
    rows
        Of attribute inference, one for each scheme, attribute, attacker and seed.
    comparisons
        Schemes, as text, that are there to compare with: they are judged, and do not decide
        whether the audit passes.
    """
    verdicts = judge(outcomes, limits=limits)
    audited = [verdict for verdict in verdicts if str(verdict.scheme) not in comparisons]
    compared = [verdict for verdict in verdicts if str(verdict.scheme) in comparisons]
    return {
        "format": FORMAT,
        "version": VERSION,
        "kind": kind,
        "passed": _passed([verdict.passed for verdict in audited]),
        "headlines": headlines(audited),
        "comparison_headlines": headlines(compared),
        "limits": {limit.name: limits.get(limit.name, limit.default) for limit in LIMITS},
        "verdicts": [
            {**verdict.to_json(), "comparison": str(verdict.scheme) in comparisons}
            for verdict in verdicts
        ],
        "model": dict(model),
        "settings": dict(settings),
        "rows": [dict(row) for row in rows],
        "outcomes": [outcome.to_json() for outcome in outcomes],
        **more,
    }


def _passed(schemes: Sequence[bool | None]) -> bool | None:
    """Say how an audit of some schemes ended; None where none failed, and one is not shown."""
    if False in schemes:
        return False
    return None if not schemes or None in schemes else True
