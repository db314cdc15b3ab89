"""When a subject is locked after failed attempts, and why a probe is refused without a decision."""

import hashlib
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from templates.errors import StoreBusy, StoreError
from templates.keys.sealing import encode_parts

_MAX_DOUBLINGS = 64


@dataclass(frozen=True)
class LockoutPolicy:
    """When a subject is locked, and for how long.

    Attributes
    ----------
    after
        Consecutive failures that lock; 0 for no lockout at all.
    first_s, longest_s
        Seconds of the first lock, which doubles with each further failure, and of the longest.
    disable_at
        Consecutive failures after which the subject stays locked until an operator resets it.

    Notes
    -----
    The k-th consecutive failure locks for min(first_s * 2**(k - after), longest_s). While a lock
    holds, nothing is decided and nothing is counted.
    """

    after: int = 5
    first_s: float = 30.0
    longest_s: float = 3600.0
    disable_at: int = 50

    def __post_init__(self) -> None:
        if self.after < 0 or not 0 < self.first_s <= self.longest_s:
            raise StoreError(
                "a lock follows 0 or more failures and lasts from first_s to longest_s"
            )
        if self.after and self.disable_at < self.after:
            raise StoreError("a subject is disabled after no fewer failures than lock it")

    def disables(self, consecutive: int) -> bool:
        """Whether so many failures disable the subject."""
        return bool(self.after) and consecutive >= self.disable_at

    def lock(self, consecutive: int) -> timedelta | None:
        """Lock that follows so many failures; None for none."""
        if not self.after or consecutive < self.after:
            return None
        doublings = min(consecutive - self.after, _MAX_DOUBLINGS)
        return timedelta(seconds=min(self.first_s * 2.0**doublings, self.longest_s))


class Superseded(StoreBusy):
    """The template that was decided on is no longer the subject's: decide again.

    Attributes
    ----------
    recorded
        False: nothing was written, and the nonce was not used up.
    """

    recorded = False

    def __init__(self) -> None:
        super().__init__(
            "the subject was enrolled, enrolled again or erased while the probe was compared: "
            "send it again"
        )


class LockedOut(StoreError):
    """Too many failed attempts on the subject.

    Attributes
    ----------
    retry_after_s
        Seconds until the lock ends; None where an operator must end it.
    recorded
        Whether the audit log has a line of it.
    """

    retry_after_s: float | None = None
    recorded = False

    def __init__(self, retry_after_s: float | None, *, recorded: bool = False) -> None:
        super().__init__(
            "too many failed attempts on this subject: it is disabled until an operator resets it"
            if retry_after_s is None
            else f"too many failed attempts on this subject: try again in {retry_after_s:.0f} s"
        )
        self.retry_after_s = retry_after_s
        self.recorded = recorded


class Replayed(StoreError):
    """An answer to a challenge, or a token, that was seen before.

    Attributes
    ----------
    recorded
        Whether the audit log has a line of it, or gets none.
    """

    recorded = False

    def __init__(
        self,
        message: str = "this was seen before: ask for another challenge or token",
        *,
        recorded: bool = False,
    ) -> None:
        super().__init__(message)
        self.recorded = recorded


@dataclass(frozen=True)
class Nonce:
    """The nonce of a challenge or a token; kept until its time alone refuses it.

    `key_prefix` is of the key that asked for it.
    """

    key_prefix: str
    value: str = field(repr=False)
    expires_at: datetime

    @property
    def hash(self) -> bytes:
        """What the store keeps of the value."""
        return hashlib.sha256(encode_parts("nonce", self.value)).digest()
