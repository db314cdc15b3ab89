"""What a verification answers."""

from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

from verify.challenge import LivenessFailure

Reason: TypeAlias = Literal["match", "no_match", "liveness"]
Liveness: TypeAlias = Literal["passed", "failed", "not_checked"]

_UNCOVER = (
    "Something may cover the face: take off a mask or dark glasses, move hair and hands away, "
    "and take another photo."
)


@dataclass(frozen=True)
class Decision:
    """Accept or reject, and by which threshold."""

    accepted: bool
    reason: Reason  # no_match also of a subject that does not exist; liveness, match or not
    level: str
    fmr: float  # the level's target; the FMR seen in calibration where it has none
    contract_id: str
    calibration_id: str
    # For keys with the right to them: with them an attacker climbs (docs/method.md §4.8). Left out
    # of `repr`, so that no log line holds them by accident.
    similarity: float = field(repr=False)
    distance: float = field(repr=False)
    score: float = field(repr=False)
    distance_threshold: float = field(repr=False)  # at which this probe would just be accepted
    liveness: Liveness = "not_checked"
    liveness_failure: LivenessFailure | None = None  # for keys with the right to scores, too
    advice: str | None = None  # on another photo, by this photo alone; where it does not match

    def with_advice(self, *, clear: bool) -> "Decision":
        """Return the decision on a photo of a face that is `clear`, or seems to be covered.

        Nothing but the photo decides on the advice, so that it tells nobody who is enrolled.
        """
        return self if clear or self.reason != "no_match" else replace(self, advice=_UNCOVER)

    def with_liveness(self, failure: LivenessFailure | None) -> "Decision":
        """Return the decision on a probe whose liveness was checked: a failure rejects."""
        if failure is None:
            return replace(self, liveness="passed")
        return replace(
            self,
            accepted=False,
            reason="liveness",
            liveness="failed",
            liveness_failure=failure,
        )


@dataclass(frozen=True)
class StandIn:
    """A template of nobody, which no probe is accepted for; decided on as any other."""

    wire: bytes = field(repr=False)
    template_id: str = "0" * 32  # a rotation is derived from it, as from a real one
    holder_salt: str | None = None
