"""Fields of a request, checked and turned into the values of the packages below."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from api.http.errors import ApiError
from models.selection import FacePolicy
from templates.errors import InvalidEmbedding
from verify import MAX_PROBE_PHOTOS

MAX_EMBEDDING = 4096
CLOCKS_DIFFER = timedelta(seconds=60)


def iso_time(value: datetime | None) -> str | None:
    """Write a time in UTC to the second, as ``2026-01-31T12:00:00Z``."""
    if value is None:
        return None
    return value.astimezone(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def in_time(expires_at: datetime, longest: timedelta) -> bool:
    """Whether something that is good for `longest` at most is good now.

    What ends later than that was made before the clock was set back, and is not good for that much
    longer. Clocks of hosts may differ by a minute.
    """
    left = expires_at - datetime.now(UTC)
    return timedelta(0) <= left <= longest + CLOCKS_DIFFER


def face_policy(value: str | None) -> FacePolicy:
    """Return which face counts when a photo shows several.

    Raises
    ------
    ApiError
        ``validation_failed``.
    """
    if value is None:
        return FacePolicy.DOMINANT
    if value not in list(FacePolicy):
        raise ApiError(
            "validation_failed", "face must be dominant, largest or single", {"field": "face"}
        )
    return FacePolicy(value)


def embedding_of(value: Any) -> NDArray[np.float64]:
    """Return a list of JSON numbers as an array, (k,); the verifier checks length and norm.

    Raises
    ------
    InvalidEmbedding
        If it is no list, is too long, or holds something that is no number.
    """
    if not isinstance(value, list) or not 0 < len(value) <= MAX_EMBEDDING:
        raise InvalidEmbedding(f"an embedding is a list of 1 to {MAX_EMBEDDING} numbers")
    if not {*map(type, value)} <= {int, float}:
        raise InvalidEmbedding("an embedding holds something that is not a number")
    try:
        return np.array(value, dtype=np.float64)
    except OverflowError:
        raise InvalidEmbedding("an embedding holds a number that is not finite") from None


def embeddings_of(value: Any) -> NDArray[np.float64]:
    """Return 1 to 5 lists of JSON numbers as an array, (k, n).

    Raises
    ------
    InvalidEmbedding
        As :func:`embedding_of`, or if there are more, or they differ in length.
    """
    if not isinstance(value, list) or not 0 < len(value) <= MAX_PROBE_PHOTOS:
        raise InvalidEmbedding(f"embeddings are a list of 1 to {MAX_PROBE_PHOTOS} lists of numbers")
    rows = [embedding_of(row) for row in value]
    if len({len(row) for row in rows}) > 1:
        raise InvalidEmbedding("the embeddings differ in length")
    return np.stack(rows)
