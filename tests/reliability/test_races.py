"""32 clients on the same subjects are answered as if they had come one after the other."""

from pathlib import Path

import pytest

from tests.reliability.races import race_run

pytestmark = pytest.mark.long


@pytest.mark.parametrize("database_url", ["sqlite", "postgres"], indirect=True)
def test_answers_have_a_serial_order(database_url: str, tmp_path: Path) -> None:
    report = race_run(database_url, tmp_path, each=8, seed=6)
    assert report.violations == []
    operations = report.figures["operations"]
    assert sum(operations.values()) >= 32 * 8
    assert min(operations[kind] for kind in ("enroll", "erase", "verify", "describe")) >= 20
    assert report.figures["most_at_once_on_one_subject"] >= 4
