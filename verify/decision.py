"""What a verification answers."""

from dataclasses import dataclass, field
from typing import Literal, TypeAlias

Reason: TypeAlias = Literal["match", "no_match"]


@dataclass(frozen=True)
class Decision:
    """Accept or reject, and by which thresholds.

    Parameters
    ----------
    accepted
        Whether the probe reached both thresholds of the level.
    reason
        ``match`` or ``no_match``; a subject that does not exist is also ``no_match``.
    level
        Security level that decided.
    fmr
        The level's target FMR; for a level without a target, the FMR seen in calibration.
    contract_id, calibration_id
        What the thresholds belong to.
    similarity, distance, cohort_score
        Scores, for keys with the right to them: returned to anyone else they let an attacker
        climb (docs/method.md §4.8). Left out of ``repr``, so that no log line holds them by
        accident.
    """

    accepted: bool
    reason: Reason
    level: str
    fmr: float
    contract_id: str
    calibration_id: str
    similarity: float = field(repr=False)
    distance: float = field(repr=False)
    cohort_score: float = field(repr=False)
