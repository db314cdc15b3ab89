"""SQLite runs out of space: a clear refusal, nothing damaged, and recovery without a restart."""

from pathlib import Path

import pytest

from tests.reliability.full_disk import full_disk_run

pytestmark = pytest.mark.long


def test_no_file_may_grow(tmp_path: Path) -> None:
    report = full_disk_run(tmp_path, rounds=1, short_s=1.0, seed=6)
    figures = report.figures
    assert report.violations == []
    assert figures["answers_503"] >= 20
    assert figures["acknowledged_enrollments"] + figures["acknowledged_erasures"] >= 40
    assert figures["acknowledged_decisions"] >= 10
