"""No acknowledged write is lost, and none is half done, when the service is killed."""

from pathlib import Path

import pytest

from tests.reliability.kill import kill_run

pytestmark = pytest.mark.long


@pytest.mark.parametrize("database_url", ["sqlite", "postgres"], indirect=True)
def test_killed_at_random_moments(
    database_url: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    report = kill_run(
        request.node.callspec.params["database_url"],
        database_url,
        tmp_path,
        operations=60,
        kills=2,
        seed=6,
    )
    assert report.violations == []
    assert report.kills_of_workers >= 1
    assert report.kills_of_the_service >= 2
    assert report.acknowledged_enrollments >= 20
    assert report.acknowledged_erasures >= 5
    assert report.acknowledged_decisions >= 20
    assert report.replays >= 4
