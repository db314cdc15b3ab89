"""Master key rotation: wrap again whatever an older key wrapped.

Only wrapped keys and secrets are touched, never a template: the work is a few hundred bytes a
subject. It runs in small writes beside a service in use. What a service seals meanwhile is sealed
inside of a write, under the key that its key file has then: none appears under the old key later.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.errors import SealError
from templates.keys.sealing import sealed_key_id
from templates.store.context import StoreContext
from templates.store.envelope import DATA_KEY_PURPOSE
from templates.store.schema import Base, RotationKeyRow, SecretRow, SubjectRow
from templates.store.secrets import SECRET_PURPOSE
from templates.store.tenants import ROTATION_PURPOSE


class Wrapped(NamedTuple):
    """A table, its column that is sealed with the master key, and what the seal is bound to."""

    table: type[Base]
    blob: str
    purpose: str
    bound_to: tuple[str, ...]


# The secrets are last: a keyring that opens them opens everything before them.
WRAPPED = (
    Wrapped(SubjectRow, "wrapped_key", DATA_KEY_PURPOSE, ("tenant_id", "id")),
    Wrapped(RotationKeyRow, "wrapped_key", ROTATION_PURPOSE, ("tenant_id", "epoch")),
    Wrapped(SecretRow, "wrapped_value", SECRET_PURPOSE, ("name",)),
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
        database, keyring, current = self._context.database, self._context.keyring, None
        total = broken = 0
        while keyring.current != current:  # again where the key file changed once more meanwhile
            current = keyring.current
            for wrapped in WRAPPED:
                after: tuple[Any, ...] | None = ()
                while after is not None:
                    changed, failed, after = database.write(
                        lambda connection, wrapped=wrapped, after=after: (  # type: ignore[misc]
                            self._rewrap(connection, wrapped, after, batch)
                        )
                    )
                    total, broken = total + changed, broken + failed
                    if progress is not None and changed:
                        progress(changed)
        database.purge_log()
        if broken:
            raise SealError(
                f"{broken} blobs do not open: their rows were altered, or a master key is missing. "
                "Put the key back and run it again, or enroll these subjects again, or erase them"
            )
        return total

    def count(self) -> dict[str, int]:
        """Count the blobs under each master key id; one that is absent wraps nothing any more."""

        def work(connection: Connection) -> dict[str, int]:
            counts: dict[str, int] = {}
            for wrapped in WRAPPED:
                wrapping_key = wrapped.table.__table__.c.wrapping_key
                query = sa.select(wrapping_key, sa.func.count()).group_by(wrapping_key)
                for key_id, count in connection.execute(query):
                    counts[key_id] = counts.get(key_id, 0) + count
            return counts

        return self._context.database.read(work)

    def _rewrap(
        self, connection: Connection, wrapped: Wrapped, after: tuple[Any, ...], batch: int
    ) -> tuple[int, int, tuple[Any, ...] | None]:
        """Wrap the next rows again; returns how many, how many do not open, and the last key."""
        keyring, table = self._context.keyring, wrapped.table.__table__
        key = sa.tuple_(*table.primary_key)
        query: Any = sa.select(table).where(table.c.wrapping_key != keyring.current)
        if after:
            query = query.where(key > sa.tuple_(*map(sa.literal, after)))
        rows = connection.execute(query.order_by(*table.primary_key).limit(batch)).all()
        broken, last = 0, None
        for row in rows:
            values = row._mapping
            last = tuple(values[column.name] for column in table.primary_key)
            bound_to = [values[name] for name in wrapped.bound_to]
            try:
                new = keyring.rewrap(
                    values[wrapped.blob], purpose=wrapped.purpose, bound_to=bound_to
                )
            except SealError:
                broken += 1
                continue
            connection.execute(
                sa.update(wrapped.table)
                .where(key == sa.tuple_(*map(sa.literal, last)))
                .values({wrapped.blob: new, "wrapping_key": sealed_key_id(new)})
            )
        return len(rows) - broken, broken, last
