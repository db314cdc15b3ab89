"""The database goes away under load and comes back; the service stays."""

from pathlib import Path

import pytest

from tests.reliability.cluster import Cluster
from tests.reliability.outage import outage_run

pytestmark = pytest.mark.long


def test_postgres_is_stopped_and_started_under_load(cluster: Cluster, tmp_path: Path) -> None:
    report = outage_run(cluster, tmp_path, modes=("fast", "immediate"), down_s=1.5, seed=6)
    assert report.violations == []
    assert all(report.figures[mode]["requests"] >= 20 for mode in ("fast", "immediate"))
    written = sum(report.figures[f"acknowledged_{what}"] for what in ("enrollments", "erasures"))
    assert written >= 120
