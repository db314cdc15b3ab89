"""How long a test waits for what must happen.

Far longer than a busy machine needs, so that only what never happens fails. No test asserts how
long something took: where a limit is tested, what it prevents would last for ever.
"""

import time
from collections.abc import Callable

PATIENCE_S = 600.0


def wait_until(
    condition: Callable[[], object], *, what: str = "what is waited for", every_s: float = 0.05
) -> None:
    """Return once the condition holds; fail where it never does."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end, f"never seen: {what}"
        time.sleep(every_s)
