"""What a deployment, a level or an API key asks for as a sign that a probe is a living person's."""

from collections.abc import Iterable
from enum import StrEnum


class LivenessPolicy(StrEnum):
    """Which detection of presentation attacks a verification must pass."""

    OFF = "off"
    PASSIVE = "passive"
    ACTIVE = "active"
    BOTH = "both"

    @property
    def passive(self) -> bool:
        """Whether the photos themselves must look live."""
        return self in (LivenessPolicy.PASSIVE, LivenessPolicy.BOTH)

    @property
    def active(self) -> bool:
        """Whether a challenge of head movements must be met."""
        return self in (LivenessPolicy.ACTIVE, LivenessPolicy.BOTH)


def joined(policies: Iterable[LivenessPolicy | None]) -> LivenessPolicy:
    """Return the policy that asks for all that any of these asks for."""
    asked = [policy for policy in policies if policy is not None]
    passive, active = any(p.passive for p in asked), any(p.active for p in asked)
    if passive and active:
        return LivenessPolicy.BOTH
    if passive:
        return LivenessPolicy.PASSIVE
    return LivenessPolicy.ACTIVE if active else LivenessPolicy.OFF
