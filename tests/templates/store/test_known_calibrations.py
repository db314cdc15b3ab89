"""A contract file that is older than one that was served is noticed."""

import sqlalchemy as sa

from templates.store import TemplateStore
from templates.store.schema import KnownCalibrationsRow

CONTRACT, OTHER = "c" * 64, "d" * 64
OLD, NEW = ["a" * 64, "b" * 64], ["a" * 64, "e" * 64]


def test_only_what_was_followed_by_others_is_superseded(store: TemplateStore) -> None:
    known = store.known_calibrations
    assert not known.are_superseded(CONTRACT, OLD)
    known.note(CONTRACT, OLD)
    assert not known.are_superseded(CONTRACT, OLD)
    known.note(CONTRACT, NEW)
    known.note(OTHER, OLD)
    assert known.are_superseded(CONTRACT, OLD)
    assert known.are_superseded(CONTRACT, OLD[::-1])
    assert not known.are_superseded(CONTRACT, NEW)
    assert not known.are_superseded(OTHER, OLD)
    # Serving the older ones does not make them the newer.
    known.note(CONTRACT, OLD)
    assert known.are_superseded(CONTRACT, OLD)
    assert not known.are_superseded(CONTRACT, NEW)


def test_a_row_that_somebody_else_wrote_supersedes_nothing(store: TemplateStore) -> None:
    store.known_calibrations.note(CONTRACT, OLD)
    row = {"contract_id": CONTRACT, "position": 2, "calibration_ids": "f" * 64}
    forged = sa.insert(KnownCalibrationsRow).values(
        **row, created_at=store._context.clock(), mac=bytes(32)
    )
    store.database.write(lambda each: each.execute(forged))
    assert not store.known_calibrations.are_superseded(CONTRACT, OLD)
    store.known_calibrations.note(CONTRACT, NEW)
    assert store.known_calibrations.are_superseded(CONTRACT, OLD)
