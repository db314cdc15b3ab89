"""Master key rotation: wrap again whatever an older key wrapped.

Only wrapped keys and secrets are touched, never a template: the work is a few hundred bytes a
subject. It runs in small writes beside a service in use. What a service seals meanwhile is sealed
inside of a write, under the key that its key file has then: none appears under the old key later.
"""

from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.orm import undefer

from templates.errors import SealError
from templates.keys.sealing import sealed_key_id
from templates.store.context import StoreContext
from templates.store.envelope import DATA_KEY_PURPOSE
from templates.store.schema import RotationKeyRow, SecretRow, SubjectRow
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


class WrappedKeys:
    """The blobs under master keys, all over the store."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def rewrap(self, *, batch: int = 200, progress: Callable[[int], None] | None = None) -> int:
        """Bring every wrapped blob under the keyring's current key; returns how many were not.

        `progress` is called after each transaction, of `batch` rows, with the number it wrapped.

        Raises
        ------
        SealError
            At the end, if blobs were altered or are under a key that the keyring lacks. All others
            are wrapped again.
        """
        keyring, current = self._context.keyring, None
        total = broken = 0
        while keyring.current != current:  # again where the key file changed once more meanwhile
            current = keyring.current
            for wrapped in WRAPPED:
                after: tuple[Any, ...] | None = ()
                while after is not None:
                    changed, failed, after = self._rewrap(wrapped, after, batch)
                    total, broken = total + changed, broken + failed
                    if progress is not None and changed:
                        progress(changed)
        self._context.database.purge_log()
        if broken:
            raise SealError(
                f"{broken} blobs do not open: their rows were altered, or a master key is missing. "
                "Put the key back and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def count(self) -> dict[str, int]:
        """Count the blobs under each master key id; one that is absent wraps nothing any more."""
        counts: Counter[str] = Counter()
        with self._context.database.read() as session:
            for wrapped in WRAPPED:
                column = wrapped.table.wrapping_key
                query = sa.select(column, sa.func.count()).group_by(column)
                for key_id, count in session.execute(query):
                    counts[key_id] += count
        return counts

    def _rewrap(
        self, wrapped: Wrapped, after: tuple[Any, ...], batch: int
    ) -> tuple[int, int, tuple[Any, ...] | None]:
        """Wrap the next rows again; returns how many, how many do not open, and the last key."""
        keyring, table, broken = self._context.keyring, wrapped.table, 0
        key = table.__table__.primary_key
        with self._context.database.write() as session:
            query = (
                sa.select(table)
                .options(undefer(table.wrapped_key))
                .where(table.wrapping_key != keyring.current)
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
                    continue
                row.wrapping_key = sealed_key_id(row.wrapped_key)
            last = sa.inspect(rows[-1]).identity if rows else None
        return len(rows) - broken, broken, last
