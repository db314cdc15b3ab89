"""When a call is sent again, and after how long.

======================================  ===================  ===============
what happened                           verifications,       all other calls
                                        conditional writes
======================================  ===================  ===============
the connection was never made           again                again
``overloaded``, ``rate_limited``        again                again
the answer was lost or took too long    **no**               again
``store_unavailable``, 502, 503, 504    **no**               again
``locked_out``, everything else         no                   no
======================================  ===================  ===============

A verification whose answer was lost may have been decided, and a rejection counts on the subject's
lockout: sending it again would count twice. A write that may replace only something, or nothing,
and an import, would be refused for what their own first sending wrote. ``model_unavailable`` is no
matter of waiting.
"""

import random
from dataclasses import dataclass

from veilface_client.calls import Resend
from veilface_client.errors import (
    ConnectionFailed,
    RateLimited,
    Unavailable,
    VeilfaceError,
)


@dataclass(frozen=True)
class Retries:
    """How often, and how patiently.

    Attributes
    ----------
    sendings
        The most times that one call is sent; 1 never sends again.
    first_s, longest_s
        Without ``Retry-After`` the wait is uniform in 0 to ``first_s``, doubled with each sending,
        up to ``longest_s``. With it, as long as it says, plus that.
    patience_s
        A ``Retry-After`` above this is not waited for: the error is raised at once.
    """

    sendings: int = 4
    first_s: float = 0.25
    longest_s: float = 8.0
    patience_s: float = 30.0

    def __post_init__(self) -> None:
        if self.sendings < 1 or min(self.first_s, self.longest_s, self.patience_s) < 0:
            raise ValueError("retries need one sending or more, and times of 0 seconds or more")

    def wait(self, error: VeilfaceError, *, sending: int, resend: Resend) -> float | None:
        """Return the seconds to wait before sending again; None: raise the error.

        Parameters
        ----------
        sending
            How often the call was sent, from 1.
        """
        if resend is Resend.NEVER or sending >= self.sendings:
            return None
        if not _heals(error, resend):
            return None
        told = getattr(error, "retry_after", None)
        if told is not None and told > self.patience_s:
            return None
        spread = min(self.longest_s, self.first_s * 2.0 ** (sending - 1))
        jitter = random.uniform(0, spread)
        return (told or 0.0) + jitter


DEFAULT_RETRIES = Retries()


def _heals(error: VeilfaceError, resend: Resend) -> bool:
    lost_is_safe = resend is Resend.WHEN_LOST
    if isinstance(error, ConnectionFailed):
        return lost_is_safe or not error.sent
    if isinstance(error, RateLimited):
        return True
    if isinstance(error, Unavailable):
        if error.code == "overloaded":
            return True
        return lost_is_safe and error.code != "model_unavailable"
    return False
