"""When a subject is locked after failed attempts, and why a probe is refused without a decision."""

from dataclasses import dataclass
from datetime import datetime, timedelta

from templates.errors import StoreError

_MAX_DOUBLINGS = 64


@dataclass(frozen=True)
class AttemptsStatus:
    """Failures on a subject; `consecutive` counts from the last accept or reset on."""

    consecutive: int
    last_failed_at: datetime
    locked_until: datetime | None
    disabled_at: datetime | None


@dataclass(frozen=True)
class LockoutPolicy:
    """When a subject is locked, and for how long.

    The k-th consecutive failure locks for min(first_s * 2**(k - after), longest_s) seconds; `after`
    0 is no lockout at all. After `disable_at` failures the subject stays locked until an operator
    resets it. While a lock holds, nothing is decided and nothing is counted.
    """

    after: int = 5
    first_s: float = 30.0
    longest_s: float = 3600.0
    disable_at: int = 50

    def status(self, consecutive: int, last_failed_at: datetime) -> AttemptsStatus:
        """Status of a subject with so many failures: the lock follows from the counts."""
        locked_until = disabled_at = None
        if self.after and consecutive >= self.after:
            doublings = min(consecutive - self.after, _MAX_DOUBLINGS)
            seconds = min(self.first_s * 2.0**doublings, self.longest_s)
            locked_until = last_failed_at + timedelta(seconds=seconds)
            disabled_at = last_failed_at if consecutive >= self.disable_at else None
        return AttemptsStatus(consecutive, last_failed_at, locked_until, disabled_at)

    def refusal(self, status: AttemptsStatus | None, now: datetime) -> "LockedOut | None":
        """Why nothing is decided on the subject now; None where it is not locked.

        A lock that seems to begin in the future, by more than its own length, is ignored: the
        clock was set back, and the lock would last until that time comes again.
        """
        if not self.after or status is None or status.locked_until is None:
            return None
        if status.disabled_at is not None:
            return LockedOut(None)
        until, length = status.locked_until, status.locked_until - status.last_failed_at
        is_locked = now < until < now + 2 * length
        return LockedOut((until - now).total_seconds()) if is_locked else None


class LockedOut(StoreError):
    """Too many failed attempts on the subject; without `retry_after_s` an operator must reset it.

    `recorded` is whether the audit log has a line of it.
    """

    retry_after_s: float | None = None
    recorded = False

    def __init__(self, retry_after_s: float | None) -> None:
        super().__init__(
            "too many failed attempts on this subject: it is disabled until an operator resets it"
            if retry_after_s is None
            else f"too many failed attempts on this subject: try again in {retry_after_s:.0f} s"
        )
        self.retry_after_s = retry_after_s


class Replayed(StoreError):
    """A token, or an answer to a challenge, that was used before or comes too late.

    `recorded` is whether the audit log has a line of it, or gets none.
    """

    recorded = False

    def __init__(
        self,
        message: str = "this was used before: ask for another token or challenge",
        *,
        recorded: bool = False,
    ) -> None:
        super().__init__(message)
        self.recorded = recorded
