"""The database goes away under load and comes back; the service stays."""

from pathlib import Path

import pytest

from tests.reliability.cluster import Cluster
from tests.reliability.outage import outage_run

pytestmark = pytest.mark.long


def test_postgres_is_stopped_and_started_under_load(cluster: Cluster, tmp_path: Path) -> None:
    report = outage_run(cluster, tmp_path, modes=("fast", "immediate"), down_s=1.5, seed=6)
    assert report.violations == []
    assert [each.mode for each in report.outages] == ["fast", "immediate"]
    assert all(each.requests >= 20 for each in report.outages)
    assert report.acknowledged_writes >= 120
