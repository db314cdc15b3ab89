"""Master key rotation: wrap again whatever an older key wrapped.

Only wrapped keys and secrets are touched, never a template: the work is a few hundred bytes a
subject. It runs in small writes beside a service in use. What a service seals meanwhile is sealed
inside of a write, under the key that its key file has then: none appears under the old key later.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.orm import load_only

from templates.errors import SealError
from templates.keys.sealing import KEY_ID_BYTES
from templates.store.context import StoreContext
from templates.store.envelope import DATA_KEY_PURPOSE
from templates.store.schema import Blob, RotationKeyRow, SecretRow, SubjectRow
from templates.store.secrets import SECRET_PURPOSE
from templates.store.tenants import ROTATION_PURPOSE


class Wrapped(NamedTuple):
    """A table whose `wrapped_key` is sealed with the master key, and what the seal is bound to."""

    table: Any
    purpose: str
    bound_to: tuple[str, ...]


# The secrets are last: a keyring that opens them opens everything before them.
WRAPPED = (
    Wrapped(SubjectRow, DATA_KEY_PURPOSE, ("tenant_id", "id")),
    Wrapped(RotationKeyRow, ROTATION_PURPOSE, ("tenant_id", "epoch")),
    Wrapped(SecretRow, SECRET_PURPOSE, ("name",)),
)


def rewrap_keys(
    context: StoreContext, *, batch: int = 200, progress: Callable[[int], None] | None = None
) -> int:
    """Bring every wrapped blob under the keyring's current key; returns how many it wrapped again.

    `progress` is called after each transaction, of `batch` rows, with the number it wrapped.

    Raises
    ------
    SealError
        At the end, if blobs were altered or are under a key that the keyring lacks. All others
        are wrapped again.
    """
    keyring, current = context.keyring, None
    total = broken = 0
    while keyring.current != current:  # again where the key file changed once more meanwhile
        current = keyring.current
        for wrapped in WRAPPED:
            after: tuple[Any, ...] | None = ()
            while after is not None:
                changed, failed, after = _rewrap(context, wrapped, after, batch)
                total, broken = total + changed, broken + failed
                if progress is not None and changed:
                    progress(changed)
    context.database.purge_log()
    if broken:
        raise SealError(
            f"{broken} blobs do not open: their rows were altered, or a master key is missing. "
            "Put the key back and run it again, or enroll these subjects again, or erase them"
        )
    return total


def count_wrapped(context: StoreContext) -> dict[str, int]:
    """Count the blobs under each master key id; one that is absent wraps nothing any more.

    What is no sealed blob is counted as ``unreadable``.
    """
    counts: Counter[str] = Counter()
    with context.database.read() as session:
        for wrapped in WRAPPED:
            query = sa.select(_key_id(wrapped).label("master_key"), sa.func.count())
            for key_id, count in session.execute(query.group_by("master_key")):
                counts[key_id.hex() or "unreadable"] += count
    return counts


def _rewrap(
    context: StoreContext, wrapped: Wrapped, after: tuple[Any, ...], batch: int
) -> tuple[int, int, tuple[Any, ...] | None]:
    """Wrap the next rows again; returns how many, how many do not open, and the last key."""
    keyring, table, broken = context.keyring, wrapped.table, 0
    key = table.__table__.primary_key
    with context.database.write() as session:
        query = (
            sa.select(table)
            .options(
                load_only(*(getattr(table, name) for name in (*wrapped.bound_to, "wrapped_key")))
            )
            .where(_key_id(wrapped) != bytes.fromhex(keyring.current))
            .order_by(*key)
            .limit(batch)
        )
        if after:
            query = query.where(sa.tuple_(*key) > sa.tuple_(*map(sa.literal, after)))
        rows = session.scalars(query).all()
        for row in rows:
            bound_to = [getattr(row, name) for name in wrapped.bound_to]
            try:
                row.wrapped_key = keyring.rewrap(
                    row.wrapped_key, purpose=wrapped.purpose, bound_to=bound_to
                )
            except SealError:
                broken += 1
        last = sa.inspect(rows[-1]).identity if rows else None
    return len(rows) - broken, broken, last


def _key_id(wrapped: Wrapped) -> Any:
    """The id of the master key, which follows a blob's version (``templates.keys.sealing``)."""
    return sa.func.substr(wrapped.table.wrapped_key, 2, KEY_ID_BYTES, type_=Blob)
