"""The calibrations that were served, so that an older contract file of the same id is noticed.

A contract's id says nothing of its calibrations: calibrating again keeps it, and an older sealed
file with other thresholds opens as well as the newer one.
"""

from collections.abc import Iterable
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from templates.store.authenticity import columns_of, is_authentic, row_mac
from templates.store.context import StoreContext
from templates.store.schema import KnownCalibrationsRow


class KnownCalibrations:
    """Sets of calibrations of each contract, in the order in which they were first served."""

    def __init__(self, context: StoreContext) -> None:
        self._context = context

    def are_superseded(self, contract_id: str, calibration_ids: Iterable[str]) -> bool:
        """Whether others of the contract were served first after these were; nothing is written."""
        ids = _joined(calibration_ids)
        served = self._context.read(lambda connection: self._served(connection, contract_id))
        return ids in served[:-1]

    def note(self, contract_id: str, calibration_ids: Iterable[str]) -> None:
        """Remember that these are served, where they are new."""
        ids = _joined(calibration_ids)

        def work(connection: Connection) -> None:
            if ids in self._served(connection, contract_id):
                return
            position = connection.execute(_LAST_POSITION, {"contract_id": contract_id})
            row = {
                "contract_id": contract_id,
                "position": (position.scalar_one() or 0) + 1,
                "calibration_ids": ids,
                "created_at": self._context.clock(),
            }
            mac = row_mac(self._context.audit_log.row_key(), KnownCalibrationsRow, row)
            connection.execute(sa.insert(KnownCalibrationsRow).values(**row, mac=mac))

        self._context.write(work, lock="known calibrations")

    def _served(self, connection: Connection, contract_id: str) -> list[str]:
        key = self._context.audit_log.row_key()
        rows: Any = connection.execute(_OF_CONTRACT, {"contract_id": contract_id})
        return [
            row.calibration_ids
            for row in rows
            if is_authentic(key, KnownCalibrationsRow, row._mapping)
        ]


def _joined(calibration_ids: Iterable[str]) -> str:
    return " ".join(sorted(calibration_ids))


_OF_CONTRACT: Any = (
    sa.select(*columns_of(KnownCalibrationsRow))
    .where(KnownCalibrationsRow.contract_id == sa.bindparam("contract_id"))
    .order_by(KnownCalibrationsRow.position)
)
_LAST_POSITION: Any = sa.select(sa.func.max(KnownCalibrationsRow.position)).where(
    KnownCalibrationsRow.contract_id == sa.bindparam("contract_id")
)
