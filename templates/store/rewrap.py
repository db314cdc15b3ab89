"""Master key rotation: wrap again whatever an older key wrapped.

Only wrapped keys and secrets are touched, never a template: the work is a few hundred bytes a
subject. It runs in small transactions beside a service in use. Each row is replaced only if it
still holds the blob that was read, so an enrollment that happens meanwhile is never undone.

Whatever is sealed under the master key is sealed inside the transaction that stores it. So after
waiting for the writes that were under way when the key changed, none can still appear under the old
key.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import sqlalchemy as sa
from sqlalchemy.engine import Connection
from sqlalchemy.orm import InstrumentedAttribute

from templates.keys.sealing import MasterKeyring, sealed_key_id
from templates.store.context import StoreContext
from templates.store.deployment import CHECK_PURPOSE, SECRET_PURPOSE
from templates.store.envelope import DATA_KEY_PURPOSE
from templates.store.schema import (
    Base,
    MasterKeyCheckRow,
    RotationKeyRow,
    SecretRow,
    SubjectRow,
)
from templates.store.tenants import ROTATION_PURPOSE

Attribute = InstrumentedAttribute[Any]


@dataclass(frozen=True)
class WrappedColumn:
    """A column of blobs under the master key, and what each blob is bound to."""

    table: type[Base]
    blob: Attribute
    wrapping_key: Attribute
    key: Sequence[Attribute]
    purpose: str
    bound_to: Sequence[Attribute]


# The mark of the master key is last: it says that everything before it is done.
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
    WrappedColumn(
        MasterKeyCheckRow,
        MasterKeyCheckRow.wrapped_value,
        MasterKeyCheckRow.wrapping_key,
        [MasterKeyCheckRow.id],
        CHECK_PURPOSE,
        [],
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
            Called after each transaction with the number of rows it re-wrapped.

        Raises
        ------
        SealError
            If a blob is under a key that the keyring lacks. What was re-wrapped before it stays so,
            and the next run goes on from there.
        StoreUnavailable
            If a write that was under way at the start does not end within the timeout.
        """
        database, keyring, total = self._context.database, self._context.keyring, 0
        current = None
        while keyring.current != current:  # again where the key file changed once more meanwhile
            current = keyring.current
            database.await_writers()
            for column in WRAPPED_COLUMNS:
                work = partial(_rewrap_batch, column=column, keyring=keyring, batch=batch)
                while any(counts := database.write(work)):
                    total += counts.changed
                    if progress is not None:
                        progress(counts.changed)
        database.purge_log()
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


class _Counts(NamedTuple):
    selected: int  # rows under another key
    changed: int  # fewer, where somebody else wrote the row meanwhile


def _rewrap_batch(
    connection: Connection, *, column: WrappedColumn, keyring: MasterKeyring, batch: int
) -> _Counts:
    rows = connection.execute(
        sa.select(column.blob.label("blob"), *dict.fromkeys((*column.key, *column.bound_to)))
        .where(column.wrapping_key != keyring.current)
        .order_by(*column.key)
        .limit(batch)
    ).all()
    changed = 0
    for row in rows:
        bound_to = [row._mapping[part.key] for part in column.bound_to]
        new = keyring.rewrap(row.blob, purpose=column.purpose, bound_to=bound_to)
        unchanged = (part == row._mapping[part.key] for part in column.key)
        result = connection.execute(
            sa.update(column.table)
            .where(column.blob == row.blob, *unchanged)
            .values({column.blob: new, column.wrapping_key: sealed_key_id(new)})
        )
        changed += result.rowcount
    return _Counts(selected=len(rows), changed=changed)
