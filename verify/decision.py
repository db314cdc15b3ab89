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
    """Accept or reject, and by which threshold.

    Parameters
    ----------
    reason
        ``match`` or ``no_match``; a subject that does not exist is also ``no_match``. ``liveness``
        where the probe is not taken for a living person's, whether it matches or not.
    fmr
        The level's target FMR; for a level without a target, the FMR seen in calibration.
    contract_id, calibration_id
        What the threshold belongs to.
    similarity, distance, score
        For keys with the right to them: returned to anyone else they let an attacker
        climb (docs/method.md §4.8). Left out of ``repr``, so that no log line holds them by
        accident.
    distance_threshold
        The distance at which this probe would just be accepted; the threshold itself is a score.
    liveness
        Whether a living person made the probe, where that was checked.
    liveness_failure
        Why not; for keys with the right to scores, like these.
    advice
        What to change in another photo, by this photo alone; only where it does not match.
    """

    accepted: bool
    reason: Reason
    level: str
    fmr: float
    contract_id: str
    calibration_id: str
    similarity: float = field(repr=False)
    distance: float = field(repr=False)
    score: float = field(repr=False)
    distance_threshold: float = field(repr=False)
    liveness: Liveness = "not_checked"
    liveness_failure: LivenessFailure | None = None
    advice: str | None = None

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
    """A template of nobody, which no probe is accepted for; decided on as any other.

    Attributes
    ----------
    wire
        Its wire bytes.
    template_id
        Any, as long as a real one: a rotation is derived from it, as from a real one.
    holder_salt
        None: no key would be the holder's.
    """

    wire: bytes = field(repr=False)
    template_id: str = "0" * 32
    holder_salt: str | None = None
