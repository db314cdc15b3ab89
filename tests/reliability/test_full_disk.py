"""SQLite runs out of space: a clear refusal, nothing damaged, and recovery without a restart."""

from pathlib import Path

import pytest

from tests.privileges import not_permitted
from tests.reliability.evidence import Report
from tests.reliability.full_disk import (
    FileSizeLimit,
    FullFileSystem,
    full_disk_run,
    may_mount,
    small_file_system,
)

pytestmark = pytest.mark.long


def assert_sound(report: Report) -> None:
    figures = report.figures
    assert report.violations == []
    assert figures["answers_503"] >= 20
    assert figures["acknowledged_enrollments"] + figures["acknowledged_erasures"] >= 40
    assert figures["acknowledged_decisions"] >= 10


def test_a_full_file_system(tmp_path: Path) -> None:
    if not may_mount():
        not_permitted("this process may not mount a small file system")
    with small_file_system() as small:
        database = small / "veilface.db"
        assert_sound(
            full_disk_run(FullFileSystem(small), database, tmp_path, rounds=1, short_s=1.0, seed=6)
        )


def test_a_limit_of_file_sizes(tmp_path: Path) -> None:
    database = tmp_path / "veilface.db"
    assert_sound(full_disk_run(FileSizeLimit(), database, tmp_path, rounds=1, short_s=1.0, seed=6))
