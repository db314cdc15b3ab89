"""No acknowledged write is lost, and none is half done, when the service is killed."""

from pathlib import Path

import pytest

from tests.reliability.kill import kill_run

pytestmark = pytest.mark.long


@pytest.mark.parametrize("database_url", ["sqlite", "postgres"], indirect=True)
def test_killed_at_random_moments(database_url: str, tmp_path: Path) -> None:
    report = kill_run(database_url, tmp_path, operations=60, kills=2, seed=6)
    assert report.violations == []
    least = {
        "kills_of_workers": 1,
        "kills_of_the_service": 2,
        "acknowledged_enrollments": 20,
        "acknowledged_erasures": 5,
        "acknowledged_decisions": 20,
        "replays": 4,
    }
    assert all(report.figures[name] >= number for name, number in least.items()), report.figures
