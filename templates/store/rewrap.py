"""Master key rotation: wrap again whatever an older key wrapped.

Only wrapped keys and secrets are touched, never a template: the work is a few hundred bytes a
subject. It runs in small writes beside a service in use. What a service seals meanwhile is sealed
inside of a write, under the key that its key file has then: none appears under the old key later.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.orm import InstrumentedAttribute

from templates.errors import SealError
from templates.keys.sealing import sealed_key_id
from templates.store.context import StoreContext
from templates.store.envelope import DATA_KEY_PURPOSE
from templates.store.schema import Base, RotationKeyRow, SecretRow, SubjectRow
from templates.store.secrets import SECRET_PURPOSE
from templates.store.tenants import ROTATION_PURPOSE

Attribute = InstrumentedAttribute[Any]


@dataclass(frozen=True)
class WrappedColumn:
    """A column of blobs under the master key, the key of its table, and what blobs are bound to."""

    table: type[Base]
    blob: Attribute
    wrapping_key: Attribute
    key: Sequence[Attribute]
    purpose: str
    bound_to: Sequence[Attribute]


# The secrets are last: a keyring that opens them opens everything before them.
WRAPPED_COLUMNS = (
    WrappedColumn(
        SubjectRow,
        SubjectRow.wrapped_key,
        SubjectRow.wrapping_key,
        [SubjectRow.id],
        DATA_KEY_PURPOSE,
        [SubjectRow.tenant_id, SubjectRow.id],
    ),
    WrappedColumn(
        RotationKeyRow,
        RotationKeyRow.wrapped_key,
        RotationKeyRow.wrapping_key,
        [RotationKeyRow.tenant_id, RotationKeyRow.epoch],
        ROTATION_PURPOSE,
        [RotationKeyRow.tenant_id, RotationKeyRow.epoch],
    ),
    WrappedColumn(
        SecretRow,
        SecretRow.wrapped_value,
        SecretRow.wrapping_key,
        [SecretRow.name],
        SECRET_PURPOSE,
        [SecretRow.name],
    ),
)


class WrappedKeys:
    """The blobs under master keys, all over the store."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def rewrap(self, *, batch: int = 200, progress: Callable[[int], None] | None = None) -> int:
        """Bring every wrapped blob under the keyring's current key; returns how many were not.

        Parameters
        ----------
        batch
            Rows in one transaction.
        progress
            Called after each transaction with the number of rows it wrapped again.

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
            for column in WRAPPED_COLUMNS:
                after: tuple[Any, ...] | None = ()
                while after is not None:
                    changed, failed, after = database.write(
                        lambda connection, column=column, after=after: (  # type: ignore[misc]
                            self._rewrap(connection, column, after, batch)
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
            for column in WRAPPED_COLUMNS:
                wrapping_key = column.wrapping_key
                query = sa.select(wrapping_key, sa.func.count()).group_by(wrapping_key)
                for key_id, count in connection.execute(query):
                    counts[key_id] = counts.get(key_id, 0) + count
            return counts

        return self._context.database.read(work)

    def _rewrap(
        self, connection: Connection, column: WrappedColumn, after: tuple[Any, ...], batch: int
    ) -> tuple[int, int, tuple[Any, ...] | None]:
        """Wrap the next rows again; returns how many, how many do not open, and the last key."""
        keyring = self._context.keyring
        columns = dict.fromkeys((*column.key, *column.bound_to))
        query: Any = (
            sa.select(column.blob.label("blob"), *columns)
            .where(column.wrapping_key != keyring.current)
            .order_by(*column.key)
            .limit(batch)
        )
        if after:
            query = query.where(sa.tuple_(*column.key) > sa.tuple_(*map(sa.literal, after)))
        rows, broken, last = connection.execute(query).all(), 0, None
        for row in rows:
            bound_to = [row._mapping[part.key] for part in column.bound_to]
            last = tuple(row._mapping[part.key] for part in column.key)
            try:
                new = keyring.rewrap(row.blob, purpose=column.purpose, bound_to=bound_to)
            except SealError:
                broken += 1
                continue
            is_row = sa.tuple_(*column.key) == sa.tuple_(*map(sa.literal, last))
            connection.execute(
                sa.update(column.table)
                .where(is_row)
                .values({column.blob: new, column.wrapping_key: sealed_key_id(new)})
            )
        return len(rows) - broken, broken, last
